"""What is behind the scene, and which part of it shows."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import viser
from jaxtyping import Float64

from ctm_plugin.scene.camera_paths import focus, looked_at
from ctm_plugin.scene.views import Scene

STEPS = 200


class SpacePanel:
    """Controls of the background and of a crop box along the world's axes.

    Args:
        client: whose page.
        scene: what is looked at.
        changed: called when something else is to be shown.
    """

    def __init__(self, client: viser.ClientHandle, scene: Scene, changed: Callable):
        gui = client.gui
        with gui.add_folder("background and crop", expand_by_default=False):
            self._background = gui.add_rgb("background", (255, 255, 255) if scene.background == "white" else (0, 0, 0))
            self._cropped = gui.add_checkbox("crop box", False)
            self._sides = [
                gui.add_multi_slider(
                    axis, float(low), float(high), float(high - low) / STEPS, (float(low), float(high))
                )
                for axis, low, high in zip("xyz", *extent(scene).tolist(), strict=True)
            ]
        self._mark = client.scene.add_box("/marks/crop", (255, 255, 255), wireframe=True, visible=False)
        for control in (self._background, self._cropped, *self._sides):
            control.on_update(changed)

    def arrange(self) -> None:
        """Draw the crop box where it is."""
        if (box := self.crop) is not None:
            low, high = np.array(box)
            self._mark.dimensions, self._mark.position = tuple(high - low), (low + high) / 2
        self._mark.visible = self._cropped.value

    @property
    def background(self) -> tuple[int, int, int]:
        red, green, blue = (min(max(int(level), 0), 255) for level in self._background.value)
        return red, green, blue

    @property
    def crop(self) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Two corners."""
        if not self._cropped.value:
            return None
        sides = [sorted(map(float, side.value)) for side in self._sides]
        return tuple(side[0] for side in sides), tuple(side[-1] for side in sides)


def extent(scene: Scene) -> Float64[np.ndarray, "2 3"]:
    """Two corners of a box with all training cameras, and what lies before them as deep again as what they look at."""
    c2w = scene.train.c2w.double().cpu().numpy()
    eyes, ahead = c2w[:, :, 3], -c2w[:, :, 2]
    if scene.geometry == "forward":
        depths = np.full(len(eyes), focus(scene.near, scene.far))
    else:
        depths = ((looked_at(scene.train) - eyes) * ahead).sum(1).clip(scene.near)
    points = np.concatenate([eyes, eyes + 2 * depths[:, None] * ahead])
    middle, half = (points.max(0) + points.min(0)) / 2, np.ptp(points, axis=0) / 2
    half = np.maximum(half, half.max() / 2)
    digits = 2 - math.floor(math.log10(half.max()))  # three of the longest side's
    return np.stack([middle - half, middle + half]).round(digits)
