"""Where photographs were taken: views by name, and their cameras in space."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import viser

from ctm_plugin.view.camera import view_camera
from ctm_plugin.view.photograph import Photograph

COLOURS = {"test": (255, 150, 40), "train": (150, 170, 190)}
PART = 0.1
"""Of the root mean square distance between cameras and their centre: a frustum's size."""


class ViewsPanel:
    """A choice of views by name; cameras that are gone to when clicked.

    Args:
        client: whose page.
        views: photographs of the test views, then of the training views.
        go: puts the camera where a photograph was taken.

    Attributes:
        here: the view that was gone to last.
    """

    def __init__(self, client: viser.ClientHandle, views: Sequence[Photograph], go: Callable[[Photograph], None]):
        gui, self._views, self._go, self.here = client.gui, views, go, views[0]
        self._choice = gui.add_dropdown("view", tuple(view.label for view in views))
        following = gui.add_button("next view")
        shown = gui.add_checkbox("cameras", False, hint="of test views in orange, of training views in grey")
        drawn = False

        @self._choice.on_update
        async def _(_: object) -> None:
            self._move(self._choice.value)

        @following.on_click
        async def _(_: object) -> None:
            self._choice.value = self._views[(self._views.index(self.here) + 1) % len(self._views)].label

        @shown.on_update
        async def _(_: object) -> None:
            nonlocal drawn
            if not drawn:
                self._draw(client)
                drawn = True
            frame.visible = shown.value

        frame = client.scene.add_frame("/marks/cameras", show_axes=False, visible=False)

    def _move(self, label: str) -> None:
        self.here = next((view for view in self._views if view.label == label), self.here)
        self._go(self.here)

    def _draw(self, client: viser.ClientHandle) -> None:
        size = mark_size(self._views)
        for number, view in enumerate(self._views):
            camera = view_camera(view.views, view.index)
            mark = client.scene.add_camera_frustum(
                f"/marks/cameras/{number}",
                camera.fov,
                camera.aspect,
                scale=size,
                thickness=1.5,
                thickness_units="screen",
                color=COLOURS["test" if view.views is self._views[0].views else "train"],
                wxyz=camera.wxyz,
                position=camera.position,
            )

            @mark.on_click
            async def _(_: object, label: str = view.label) -> None:
                if self._choice.value == label:
                    self._move(label)
                self._choice.value = label


def mark_size(views: Sequence[Photograph]) -> float:
    """How large cameras are drawn, in scene units."""
    eyes = np.array([view.views.c2w[view.index, :, 3].tolist() for view in views])
    return PART * (float(np.sqrt(((eyes - eyes.mean(0)) ** 2).sum(1).mean())) or 1.0)
