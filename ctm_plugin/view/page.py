"""A client's page: its controls, its camera, and what it asks for."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import imageio.v3 as iio
import numpy as np
import torch
import viser
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.color.settings import MOST_STOPS
from ctm_plugin.runs.load import KINDS
from ctm_plugin.scene.camera_paths import mean_up
from ctm_plugin.scene.views import Scene
from ctm_plugin.show.pictures import depth_picture
from ctm_plugin.view.camera import Camera, ahead, extent, view_camera
from ctm_plugin.view.live_run import Subject
from ctm_plugin.view.look import LAYOUTS, Look, Shot
from ctm_plugin.view.painter import Limit
from ctm_plugin.view.path import PathPanel
from ctm_plugin.view.photograph import Photograph
from ctm_plugin.view.settings import MOST_SECONDS, SIZES, ViewConfig

LABELS = dict(zip(("lit", "dark", "latent", "depth"), KINDS, strict=True))
NOTHING, PHOTOGRAPH = "nothing", "photograph"
COLOURS = {"test": (255, 150, 40), "train": (150, 170, 190)}
PART = 0.1
"""Of the root mean square distance between cameras and their centre: a drawn camera's size."""
CROP_STEPS = 200


class Page:
    """What a client sees, from the first test view on.

    Browsers are not trusted: what controls say is brought into its range.

    Args:
        client: whose.
        subjects: runs by name.
        views: photographs, the test views' first.
        stops: where the light begins.
        settings: where size and time begin.
        ask: called with what is to be painted.

    Attributes:
        here: the view that was gone to last.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        subjects: dict[str, Subject],
        views: Sequence[Photograph],
        stops: float,
        settings: ViewConfig,
        ask: Callable[[Look, Limit], None],
    ):
        self._client, self._subjects, self._views, self._ask, self.here = client, subjects, views, ask, views[0]
        self._scene = scene = next(iter(subjects.values())).scene
        self._marks = client.scene.add_frame("/marks", show_axes=False)
        self._levels: np.ndarray | None = None
        self._add_picture_controls(client.gui, tuple(subjects), stops)
        self._add_view_controls(client)
        # Plain text: viser's Markdown would run what stands in it, such as a folder's name, in the browser.
        self.status = client.gui.add_text("shown", "", disabled=True)
        self.trouble = client.gui.add_text("checkpoint", "", disabled=True, visible=False)
        client.gui.add_button("save the picture").on_click(self._save)
        self._add_quality_controls(client, settings)
        self._add_space_controls(client)
        self.path = PathPanel(client, scene.name, mark_size(views) / 2, self._aim)

        async def changed(_: object) -> None:
            self.ask()

        for control in (
            self.run, self.kind, self.stops, self.beside, self.layout, self.split,
            self.size, self.seconds, self.background, self.cropped, *self.sides,
        ):  # fmt: skip
            control.on_update(changed)
        client.camera.on_update(changed)
        self._place(views[0])

    def _add_picture_controls(self, gui: viser.GuiApi, runs: Sequence[str], stops: float) -> None:
        """Which run, which picture of it, and what stands next to it."""
        scene, several = self._scene, len(runs) > 1
        self.run = gui.add_dropdown("run", tuple(runs), visible=several)
        self.kind = gui.add_dropdown("picture", tuple(LABELS), initial_value="lit")
        label = f"depth, from {scene.near:.4g} to {scene.far:.4g}"
        self.legend = gui.add_image(legend(scene), label=label, format="png", visible=False)
        self.stops = gui.add_slider(
            "light, stops", -MOST_STOPS, MOST_STOPS, 0.1, round(stops, 1), hint="of lit pictures: 1 doubles it"
        )
        beside = (NOTHING, *(runs if several else ()), PHOTOGRAPH)
        self.beside = gui.add_dropdown("next to it", beside, initial_value=runs[1] if several else NOTHING)
        self.layout = gui.add_dropdown("compare by", LAYOUTS)
        self.split = gui.add_slider("left part", 0.0, 1.0, 0.01, 0.5, hint="how much of the width is the run's")

    def _add_view_controls(self, client: viser.ClientHandle) -> None:
        """Views by name; cameras that are gone to when clicked."""
        by_label = {view.label: view for view in self._views}
        self.view = client.gui.add_dropdown("view", tuple(by_label))
        following = client.gui.add_button("next view")
        shown = client.gui.add_checkbox("cameras", False, hint="of test views in orange, of training views in grey")
        frame = client.scene.add_frame("/marks/cameras", show_axes=False, visible=False)
        drawn = False

        @self.view.on_update
        async def _(_: object) -> None:
            self._place(by_label.get(self.view.value, self.here))

        @following.on_click
        async def _(_: object) -> None:
            self.view.value = self._views[(self._views.index(self.here) + 1) % len(self._views)].label

        @shown.on_update
        async def _(_: object) -> None:
            nonlocal drawn
            if not drawn:
                self._draw_cameras(client.scene)
                drawn = True
            frame.visible = shown.value

    def _draw_cameras(self, scene: viser.SceneApi) -> None:
        size = mark_size(self._views)
        for number, view in enumerate(self._views):
            camera = view_camera(view.views, view.index)
            mark = scene.add_camera_frustum(
                f"/marks/cameras/{number}", camera.fov, camera.aspect, size, thickness=1.5, thickness_units="screen",
                color=COLOURS["test" if view.views is self._views[0].views else "train"],
                wxyz=camera.wxyz, position=camera.position,
            )  # fmt: skip

            @mark.on_click
            async def _(_: object, view: Photograph = view) -> None:
                if self.view.value == view.label:
                    self._place(view)
                self.view.value = view.label

    def _add_quality_controls(self, client: viser.ClientHandle, settings: ViewConfig) -> None:
        window = max(client.camera.image_width, client.camera.image_height)
        size = settings.size or min(max(window, SIZES[0]), SIZES[1])
        with client.gui.add_folder("quality", expand_by_default=False):
            self.size = client.gui.add_number("longer side", size, min=SIZES[0], max=SIZES[1], step=1, hint="pixels")
            self.seconds = client.gui.add_number(
                "seconds", settings.seconds, min=0.1, max=float(MOST_SECONDS), step=0.1
            )

    def _add_space_controls(self, client: viser.ClientHandle) -> None:
        """What is behind the scene, and a crop box along the world's axes."""
        colour = (255, 255, 255) if self._scene.background == "white" else (0, 0, 0)
        with client.gui.add_folder("background and crop", expand_by_default=False):
            self.background = client.gui.add_rgb("background", colour)
            self.cropped = client.gui.add_checkbox("crop box", False)
            self.sides = [
                client.gui.add_multi_slider(axis, low, high, (high - low) / CROP_STEPS, (low, high))
                for axis, low, high in zip("xyz", *extent(self._scene).tolist(), strict=True)
            ]
        self._box = client.scene.add_box("/marks/crop", (255, 255, 255), wireframe=True, visible=False)

    def look(self) -> Look | None:
        """What the controls and the camera say; ``None`` while they make no sense."""
        at, beside = self._client.camera, self.beside.value
        camera = Camera(tuple(at.wxyz), tuple(at.position), at.fov, at.aspect)
        if not camera.usable():
            return None
        sources = [self._subjects[self.run.value]]
        if beside != NOTHING:
            sources.append(self.here if beside == PHOTOGRAPH else self._subjects[beside])
        red, green, blue = (min(max(int(level), 0), 255) for level in self.background.value)
        sides = [sorted(map(float, side.value)) for side in self.sides]
        crop = (tuple(side[0] for side in sides), tuple(side[-1] for side in sides)) if self.cropped.value else None
        factor = 2.0 ** min(max(self.stops.value, -MOST_STOPS), MOST_STOPS)
        shot = Shot(camera, (red, green, blue), crop)
        return Look(shot, tuple(sources), self.layout.value, self.split.value, LABELS[self.kind.value], factor)

    @property
    def limit(self) -> Limit:
        size, seconds = int(self.size.value), float(self.seconds.value)
        return Limit(min(max(size, SIZES[0]), SIZES[1]), min(max(seconds, 0.1), MOST_SECONDS))

    def ask(self) -> None:
        """Have it painted, and show the controls and marks that mean something now."""
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
        """Put a picture behind everything, and tell what it is."""
        self._levels = (picture.clamp(0, 1) * 255).round().byte().numpy()
        self._client.scene.set_background_image(self._levels, format="png")
        subject, *beside = look.sources
        height, width = self._levels.shape[:2]
        status = f"step {subject.run.step}, {width}x{height} in {seconds:.2f} s"
        if beside and isinstance(beside[0], Photograph) and not beside[0].seen_from(look.shot.camera):
            status += f"; {beside[0].label} as taken"
        self.status.value = status
        self.trouble.value = "; ".join(s.trouble for s in look.sources if isinstance(s, Subject) and s.trouble)
        self.trouble.visible = bool(self.trouble.value)

    def _save(self, _: object) -> None:
        if self._levels is not None:
            content = iio.imwrite("<bytes>", self._levels, extension=".png")
            name = f"{self._scene.name}_{LABELS[self.kind.value]}.png"
            self._client.send_file_download(name, content, save_immediately=True)

    def _place(self, view: Photograph) -> None:
        """Put the camera where a view's is, upright as the scene is."""
        self.here = view
        self._turn(view_camera(view.views, view.index), mean_up(self._scene.train), view.views.c2w[view.index])

    def _aim(self, camera: Camera) -> None:
        """Put the camera somewhere, turned as it is."""
        self._turn(camera, camera.c2w[:, 1].double().numpy(), camera.c2w)

    def _turn(self, camera: Camera, up: np.ndarray, c2w: Float[Tensor, "3 4"]) -> None:
        at = self._client.camera
        with self._client.atomic():
            at.up_direction, at.position, at.fov = up, camera.position, camera.fov
            at.look_at = ahead(self._scene, c2w[None])[0]


def legend(scene: Scene) -> np.ndarray:
    """The colours of depths from near to far, bytes ``[16, 256, 3]``."""
    depths = torch.linspace(scene.near, scene.far, 256).expand(16, 256)
    return (depth_picture(depths, scene.near, scene.far) * 255).round().byte().numpy()


def mark_size(views: Sequence[Photograph]) -> float:
    """How large cameras are drawn, in scene units."""
    eyes = np.array([view.views.c2w[view.index, :, 3].tolist() for view in views])
    return PART * (float(np.sqrt(((eyes - eyes.mean(0)) ** 2).sum(1).mean())) or 1.0)
