"""The page of one browser client: its controls, its camera, and its requests for pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import imageio.v3 as iio
import numpy as np
import torch
import viser
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.color.light import Light
from ctm_plugin.color.settings import CONTRASTS, MAX_STOPS, SATURATIONS
from ctm_plugin.data.readers.images import to_8_bits
from ctm_plugin.runs.load import VIEW_KINDS
from ctm_plugin.scene.camera_paths import mean_up
from ctm_plugin.scene.views import Scene
from ctm_plugin.show.pictures import depth_picture
from ctm_plugin.view.camera import BrowserCamera, ahead, extent
from ctm_plugin.view.painter import LAYOUTS, Limit, Look, Viewpoint
from ctm_plugin.view.path import PathPanel, called, camera_of
from ctm_plugin.view.sources import PhotographSource, Subject

LABELS = dict(zip(("lit", "dark", "latent", "depth"), VIEW_KINDS, strict=True))
NOTHING, PHOTOGRAPH = "nothing", "photograph"
CAMERA_COLOURS = {"test": (255, 150, 40), "train": (150, 170, 190)}
"""Colours of drawn cameras by split."""
FRUSTUM_SIZE = 0.1
"""Size of a drawn camera, as a share of the root mean square distance between cameras and their centre."""
CROP_STEPS = 200
"""Steps of a slider along the scene's box."""
SIDES = (64, 4096)
"""Least and largest longer side in pixels of the finest picture."""
MAX_SECONDS = 600.0
"""Largest number of seconds that a picture may take."""


class Page:
    """Page of one browser client; it begins at the first test view.

    Args:
        client: viser's handle of the browser client.
        subjects: runs by name.
        views: photographs, the test views' first.
        light: initial light of the sliders.
        ask: function that is called with the look to be painted.

    Attributes:
        here: the view that the camera went to last.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        subjects: dict[str, Subject],
        views: Sequence[PhotographSource],
        light: Light,
        ask: Callable[[Look, Limit], None],
    ):
        self._client, self._subjects, self._views, self._ask, self.here = client, subjects, views, ask, views[0]
        self._scene, self._levels = next(iter(subjects.values())).scene, None
        self._marks = client.scene.add_frame("/marks", show_axes=False)
        changing = [*self._picture_controls(client.gui, tuple(subjects), light)]
        self._view_controls(client)
        # Plain text: viser's Markdown would run what stands in it, such as a folder's name, in the browser.
        self.status = client.gui.add_text("shown", "", disabled=True)
        self.trouble = client.gui.add_text("checkpoint", "", disabled=True, visible=False)
        client.gui.add_button("save the picture").on_click(called(self._save))
        changing += [*self._quality_controls(client), *self._space_controls(client)]
        lit = (self.stops, self.contrast, self.saturation)
        self.path = PathPanel(client, self._scene.name, mark_size(views) / 2, self._aim, lit)
        for each in (*changing, client.camera):
            each.on_update(called(self.ask))
        self._place(views[0])

    def _picture_controls(self, gui: viser.GuiApi, runs: Sequence[str], light: Light) -> list[viser.GuiInputHandle]:
        """Make the controls of the run, its kind of picture, and the picture next to it."""
        scene, several = self._scene, len(runs) > 1
        self.run = gui.add_dropdown("run", runs, visible=several)
        self.kind = gui.add_dropdown("picture", tuple(LABELS))
        label = f"depth, from {scene.near:.4g} to {scene.far:.4g}"
        self.legend = gui.add_image(legend(scene), label=label, format="png", visible=False)
        stops, hint = round(math.log2(light.gain), 2), "of lit pictures: 1 doubles it"
        self.stops = gui.add_slider("light, stops", -MAX_STOPS, MAX_STOPS, 0.02, stops, hint=hint)
        hint = "of lit pictures; 1: as photographed"
        self.contrast = gui.add_slider("contrast", *CONTRASTS, 0.01, light.contrast, hint=hint)
        self.saturation = gui.add_slider("saturation", *SATURATIONS, 0.01, light.saturation, hint=hint)
        beside = (NOTHING, *(runs if several else ()), PHOTOGRAPH)
        self.beside = gui.add_dropdown("next to it", beside, initial_value=runs[1] if several else NOTHING)
        self.layout = gui.add_dropdown("compare by", LAYOUTS)
        self.split = gui.add_slider("left part", 0.0, 1.0, 0.01, 0.5, hint="how much of the width is the run's")
        return [self.run, self.kind, self.stops, self.contrast, self.saturation, self.beside, self.layout, self.split]

    def _view_controls(self, client: viser.ClientHandle) -> None:
        """Make the controls that go to a view by name, or by a click on its drawn camera."""
        by_label = {view.label: view for view in self._views}
        self.view = client.gui.add_dropdown("view", tuple(by_label))
        following = client.gui.add_button("next view")
        hint = "of test views in orange, of training views in grey"
        self.cameras = client.gui.add_checkbox("cameras", False, hint=hint)
        self._frame = client.scene.add_frame("/marks/cameras", show_axes=False, visible=False)
        self.drawn: list[viser.CameraFrustumHandle] = []

        def go_on() -> None:
            self.view.value = self._views[(self._views.index(self.here) + 1) % len(self._views)].label

        self.view.on_update(called(lambda: self._place(by_label[self.view.value])))
        following.on_click(called(go_on))
        self.cameras.on_update(called(self.show_cameras))

    def show_cameras(self) -> None:
        """Show or hide the views' cameras; the first time they are drawn."""
        for number, view in enumerate([] if self.drawn else self._views):
            camera, split = view.camera, "test" if view.views is self._views[0].views else "train"
            mark = self._client.scene.add_camera_frustum(
                f"/marks/cameras/{number}", camera.fov, camera.aspect, scale=mark_size(self._views), thickness=1.5,
                thickness_units="screen", color=CAMERA_COLOURS[split], wxyz=camera.wxyz, position=camera.position,
            )  # fmt: skip

            def go(view: PhotographSource = view) -> None:
                if self.view.value == view.label:  # else its control does
                    self._place(view)
                self.view.value = view.label

            mark.on_click(called(go))
            self.drawn.append(mark)
        self._frame.visible = self.cameras.value

    def _quality_controls(self, client: viser.ClientHandle) -> list[viser.GuiInputHandle]:
        size = min(max(client.camera.image_width, client.camera.image_height, SIDES[0]), SIDES[1])
        with client.gui.add_folder("quality", expand_by_default=False):
            self.size = client.gui.add_number("longer side", size, min=SIDES[0], max=SIDES[1], step=1, hint="pixels")
            self.seconds = client.gui.add_number("seconds", Limit().seconds, min=0.1, max=MAX_SECONDS, step=0.1)
        return [self.size, self.seconds]

    def _space_controls(self, client: viser.ClientHandle) -> list[viser.GuiInputHandle]:
        """Make the controls of the background, and of a crop box along the world's axes."""
        colour = (255, 255, 255) if self._scene.background == "white" else (0, 0, 0)
        with client.gui.add_folder("background and crop", expand_by_default=False):
            self.background = client.gui.add_rgb("background", colour)
            self.cropped = client.gui.add_checkbox("crop box", False)
            self.sides = [
                client.gui.add_multi_slider(axis, low, high, (high - low) / CROP_STEPS, (low, high))
                for axis, low, high in zip("xyz", *extent(self._scene).tolist(), strict=True)
            ]
        self._box = client.scene.add_box("/marks/crop", (255, 255, 255), wireframe=True, visible=False)
        return [self.background, self.cropped, *self.sides]

    def look(self) -> Look | None:
        """The look that the controls and the camera ask for; ``None`` while they are invalid."""
        camera, beside = camera_of(self._client), self.beside.value
        if camera is None:
            return None
        sources = [self._subjects[self.run.value]]
        if beside != NOTHING:
            sources.append(self.here if beside == PHOTOGRAPH else self._subjects[beside])
        crop = tuple(zip(*(sorted(side.value) for side in self.sides), strict=True)) if self.cropped.value else None
        shot = Viewpoint(camera, tuple(self.background.value), crop)
        kind = LABELS[self.kind.value]
        light = Light(2.0**self.stops.value, self.contrast.value, self.saturation.value)
        return Look(shot, tuple(sources), self.layout.value, self.split.value, kind, light)

    @property
    def limit(self) -> Limit:
        """The limit of size and seconds that the controls ask for, cut to its range while a number is being typed."""
        size, seconds = int(self.size.value), float(self.seconds.value)
        return Limit(min(max(size, SIDES[0]), SIDES[1]), min(max(seconds, 0.1), MAX_SECONDS))

    def ask(self) -> None:
        """Request the picture of the present look, and show only the controls that apply to it."""
        two = self.beside.value != NOTHING
        self.legend.visible = self.kind.value == "depth"
        self.layout.visible, self.split.visible = two, two and self.layout.value == "slider"
        self._box.visible = self.cropped.value
        if (look := self.look()) is not None:
            if look.shot.crop is not None:
                low, high = np.array(look.shot.crop)
                self._box.dimensions, self._box.position = tuple(high - low), (low + high) / 2
            # Cameras and boxes are drawn over the whole window, not over each half.
            self._marks.visible = len(look.sources) == 1 or look.layout == "slider"
            self._ask(look, self.limit)

    def show(self, look: Look, picture: Float[Tensor, "h w 3"], seconds: float) -> None:
        """Set a painted picture as the page's background, and describe it in the page."""
        self._levels = to_8_bits(picture).numpy()
        self._client.scene.set_background_image(self._levels, format="png")
        subject, *beside = look.sources
        height, width = self._levels.shape[:2]
        status = f"step {subject.run.step}, {width}x{height} in {seconds:.2f} s"
        if beside and isinstance(beside[0], PhotographSource) and not beside[0].seen_from(look.shot.camera):
            status += f"; {beside[0].label} as taken"
        self.status.value = status
        self.trouble.value = "; ".join(s.trouble for s in look.sources if isinstance(s, Subject) and s.trouble)
        self.trouble.visible = bool(self.trouble.value)

    def _save(self) -> None:
        if self._levels is not None:
            content = iio.imwrite("<bytes>", self._levels, extension=".png")
            name = f"{self._scene.name}_{LABELS[self.kind.value]}.png"
            self._client.send_file_download(name, content, save_immediately=True)

    def _place(self, view: PhotographSource) -> None:
        """Move the browser's camera to a view's camera, with the scene's up direction."""
        self.here = view
        self._aim(view.camera, mean_up(self._scene.train))

    def _aim(self, camera: BrowserCamera, up: Float[np.ndarray, " 3"] | None = None) -> None:
        """Move the browser's camera to ``camera``; ``up``: the new up direction, if given."""
        at = self._client.camera
        with self._client.atomic():
            at.up_direction = camera.c2w[:, 1].double().numpy() if up is None else up
            at.position, at.fov, at.look_at = camera.position, camera.fov, ahead(self._scene, camera.c2w[None])[0]


def legend(scene: Scene) -> np.ndarray:
    """The colours of depths from near to far, bytes ``[16, 256, 3]``."""
    depths = torch.linspace(scene.near, scene.far, 256).expand(16, 256)
    return to_8_bits(depth_picture(depths, scene.near, scene.far)).numpy()


def mark_size(views: Sequence[PhotographSource]) -> float:
    """Size of drawn cameras, in scene units."""
    eyes = np.array([view.camera.position for view in views])
    return FRUSTUM_SIZE * (float(np.sqrt(((eyes - eyes.mean(0)) ** 2).sum(1).mean())) or 1.0)
