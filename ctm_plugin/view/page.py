"""A client's page: its panels, its camera, and what it asks for."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import viser
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.scene.camera_paths import mean_up
from ctm_plugin.scene.views import Scene
from ctm_plugin.view.camera import Camera, pivot, view_camera
from ctm_plugin.view.command import SIZES, ViewConfig
from ctm_plugin.view.live_run import Subject
from ctm_plugin.view.look import Look, Shot
from ctm_plugin.view.painter import Limit
from ctm_plugin.view.panels.path import PathPanel
from ctm_plugin.view.panels.picture import NOTHING, PHOTOGRAPH, PicturePanel
from ctm_plugin.view.panels.quality import QualityPanel
from ctm_plugin.view.panels.space import SpacePanel
from ctm_plugin.view.panels.views import ViewsPanel, mark_size
from ctm_plugin.view.photograph import Photograph


class Page:
    """What a client sees, from the first test view on.

    Args:
        client: whose.
        subjects: runs by name.
        views: photographs, the test views' first.
        stops: where the light begins.
        settings: where size and time begin.
        ask: called with what is to be painted.
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
        self._client, self._subjects, self._ask = client, subjects, ask
        self._scene = scene = next(iter(subjects.values())).scene
        self._marks = client.scene.add_frame("/marks", show_axes=False)
        window = max(client.camera.image_width, client.camera.image_height)
        limit = Limit(settings.size or min(max(window, SIZES[0]), SIZES[1]), settings.seconds)

        async def changed(_: object) -> None:
            self.ask()

        self.picture = PicturePanel(client.gui, tuple(subjects), scene, stops, changed)
        self.views = ViewsPanel(client, views, self._place)
        self.quality = QualityPanel(client, limit, changed, lambda: f"{scene.name}_{self.picture.kind}")
        self.space = SpacePanel(client, scene, changed)
        self.path = PathPanel(client, scene.name, mark_size(views) / 2, self._aim)
        client.camera.on_update(changed)
        self._place(views[0])

    def look(self) -> Look | None:
        """What the controls and the camera say; ``None`` while they make no sense."""
        at, picture = self._client.camera, self.picture
        camera = Camera(tuple(at.wxyz), tuple(at.position), at.fov, at.aspect)
        if not camera.usable():
            return None
        sources = [self._subjects[picture.run]]
        if picture.beside != NOTHING:
            sources.append(self.views.here if picture.beside == PHOTOGRAPH else self._subjects[picture.beside])
        shot = Shot(camera, self.space.background, self.space.crop)
        return Look(shot, tuple(sources), picture.layout, picture.split, picture.kind, picture.factor)

    def ask(self) -> None:
        """Have it painted."""
        self.picture.arrange()
        self.space.arrange()
        if (look := self.look()) is not None:
            # Cameras and boxes are drawn over the whole window, not over each half.
            self._marks.visible = len(look.sources) == 1 or look.layout == "slider"
            self._ask(look, self.quality.limit)

    def show(self, look: Look, picture: Float[Tensor, "h w 3"], seconds: float) -> None:
        """Put a picture behind everything, and tell what it is."""
        levels = (picture.clamp(0, 1) * 255).round().byte().numpy()
        self._client.scene.set_background_image(levels, format="png")
        subject, *beside = look.sources
        height, width = levels.shape[:2]
        status = f"step {subject.run.step}, {width}x{height} in {seconds:.2f} s"
        if beside and isinstance(beside[0], Photograph) and not beside[0].seen_from(look.shot.camera):
            status += f"; {beside[0].label} as taken"
        self.quality.show(
            levels, status, "; ".join(s.trouble for s in look.sources if isinstance(s, Subject) and s.trouble)
        )

    def _place(self, view: Photograph) -> None:
        """Put the camera where a view's is, upright as the scene is."""
        camera, c2w = view_camera(view.views, view.index), view.views.c2w[view.index].cpu()
        self._turn(camera, mean_up(self._scene.train), pivot(self._scene, c2w))

    def _aim(self, camera: Camera) -> None:
        """Put the camera somewhere, turned as it is."""
        self._turn(camera, camera.c2w[:, 1].double().numpy(), pivot(self._scene, camera.c2w))

    def _turn(self, camera: Camera, up: object, towards: object) -> None:
        at = self._client.camera
        with self._client.atomic():
            at.up_direction, at.position, at.look_at, at.fov = up, camera.position, towards, camera.fov


def photographs(scene: Scene, background: Float[Tensor, "1 3"]) -> list[Photograph]:
    """The test views, then the training views, each by name."""
    splits = (("", scene.test), ("train: ", scene.train))
    return [
        Photograph(f"{label}{name}", views, index, background)
        for label, views in splits
        for index, name in enumerate(views.names)
    ]
