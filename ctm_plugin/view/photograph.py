"""A photograph, seen from the browser's camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.color.light import brighten
from ctm_plugin.rays.cameras import distort
from ctm_plugin.scene.views import Scene, Views, composite
from ctm_plugin.view.camera import Camera, view_camera
from ctm_plugin.view.look import GoOn, Rendered, Shot

NEAR = 1e-3
"""Distance from where it was taken, in parts of the camera's from the origin or of 1, within which it is seen."""


@dataclass(frozen=True, eq=False)
class Photograph:
    """One of a scene's views, turned as the camera is where it was taken; elsewhere it stays as taken.

    Attributes:
        label: for people.
        views, index: which one.
        background: ``[1, 3]``, behind transparent pixels.
    """

    label: str
    views: Views
    index: int
    background: Tensor
    version = None

    def changed(self) -> bool:
        return False

    def refresh(self) -> None:
        pass

    def seen_from(self, camera: Camera) -> bool:
        """Whether a camera stands where it was taken."""
        eye = self.views.c2w[self.index, :, 3].double().numpy()
        return bool(np.linalg.norm(eye - camera.position) <= NEAR * max(1.0, float(np.linalg.norm(eye))))

    def render(self, shot: Shot, height: int, width: int, go_on: GoOn) -> Rendered:
        """Looked up where the camera's rays meet the photograph, through its lens; black outside it."""
        camera = shot.camera
        if not self.seen_from(camera):
            camera = replace(view_camera(self.views, self.index), fov=camera.fov, aspect=camera.aspect)
        views, index = self.views, self.index
        x, y, z = (camera.rays(height, width).directions @ views.c2w[index, :, :3].cpu()).unbind(1)
        u, v, ahead = x / -z, y / z, z < -1e-6
        if views.distortion is not None:
            u, v = distort(u, v, views.distortion[index].cpu())
        fx, fy, cx, cy = views.intrinsics[index].tolist()
        at = torch.stack([2 * (fx * u + cx) / views.width - 1, 2 * (fy * v + cy) / views.height - 1], dim=1)
        picture = composite(views.images[index].cpu(), self.background).permute(2, 0, 1)[None]
        found = F.grid_sample(picture, at.view(1, height, width, 2), padding_mode="border", align_corners=False)
        inside = (ahead & (at.abs() <= 1).all(1)).view(height, width, 1)
        return {"rgb": found[0].permute(1, 2, 0) * inside}

    def picture(self, rendered: Rendered, kind: str, factor: float) -> Float[Tensor, "h w 3"]:
        """Brightened, unless the run's is as rendered: a photograph has no latent and no depth."""
        return rendered["rgb"] if kind == "rgb" else brighten(rendered["rgb"], factor)


def photographs(scene: Scene, background: Float[Tensor, "1 3"]) -> list[Photograph]:
    """The test views, then the training views, each by name."""
    splits = (("", scene.test), ("train: ", scene.train))
    return [
        Photograph(f"{label}{name}", views, index, background)
        for label, views in splits
        for index, name in enumerate(views.names)
    ]
