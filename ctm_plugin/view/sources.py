"""Sources of pictures: runs, finished or still in training, and photographs seen from the browser's camera."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.backbones.pictures import PictureBackbone
from ctm_plugin.color.light import Light
from ctm_plugin.errors import CTMError
from ctm_plugin.rays.cameras import Rays, distort
from ctm_plugin.rays.ndc import MIN_FORWARD
from ctm_plugin.rays.sampling import intersect_box
from ctm_plugin.runs.load import load_posed
from ctm_plugin.runs.rundir import LAST
from ctm_plugin.scene.views import Scene, Views, composite
from ctm_plugin.view.camera import BrowserCamera, view_camera
from ctm_plugin.view.painter import Rendered, Viewpoint

RAY_CHUNK = 2048
"""Rays rendered between two checks for a newer request."""
PHOTOGRAPH_DISTANCE = 1e-3
"""Distance from a photograph's camera, relative to that camera's distance from the origin or to 1, within which the
photograph is shown."""


class Subject:
    """A run to view, at its last checkpoint; it is read again when that is replaced.

    Args:
        folder: the run directory.
        root: the folder of its data, see :func:`ctm_plugin.runs.load.load_run`.

    Attributes:
        trouble: reason why the present checkpoint could not be used, else empty.

    Raises:
        CTMError: see :func:`ctm_plugin.runs.load.load_posed`.
    """

    def __init__(self, folder: Path, root: str | None = None):
        self.folder, self.root, self.trouble = folder, root, ""
        self._read = self._stamp()
        self.run = load_posed(folder, root)

    @property
    def scene(self) -> Scene:
        return self.run.module.scene

    def refresh(self) -> bool:
        """Load the run's checkpoint if it is newer than the loaded one, and tell whether it was.

        A checkpoint that cannot be used leaves the loaded one in place and sets ``trouble``.
        """
        stamp = self._stamp()
        if stamp in (None, self._read):
            return False
        self._read = stamp
        try:
            self.run, self.trouble = load_posed(self.folder, self.root, scene=self.scene), ""
        except CTMError as error:
            self.trouble = str(error)
        return True

    def _stamp(self) -> tuple[int, ...] | None:
        try:
            stat = (self.folder / LAST).stat()
        except OSError:  # between two checkpoints there is none for a moment
            return None
        return stat.st_ino, stat.st_mtime_ns, stat.st_size

    @torch.no_grad()
    def render(self, shot: Viewpoint, height: int, width: int, check: Callable[[], None]) -> Rendered:
        """Render the tensors ``[H, W, ...]`` that :meth:`ctm_plugin.runs.load.LoadedRun.picture` needs, on the CPU.

        With a crop box, rays begin where they enter it, and those that end behind it, by their expected depth, show the
        background; so do rays that miss it. In normalised device coordinates all rays begin at the near plane, and in
        whole pictures at the camera. ``check`` is called every ``RAY_CHUNK`` rays; whole pictures are too fast for it.
        """
        module, scene = self.run.module, self.scene
        color = torch.tensor([shot.background], device=module.device) / 255
        behind, count = module.transform.encode(color), height * width
        enter, leave = torch.zeros(count, device=module.device), torch.full((count,), math.inf, device=module.device)
        if whole := isinstance(module, PictureBackbone):
            picture = module.render(shot.camera.views(height, width), 0, behind, None)
            latent, depth = picture.latent.flatten(0, 1), picture.depth.flatten()
        if shot.crop is not None or not whole:
            rays = Rays(*(part.to(module.device) for part in shot.camera.rays(height, width)))
        if shot.crop is not None:
            enter, leave = intersect_box(rays, rays.origins.new_tensor(shot.crop), 0.0, math.inf)
        if not whole:
            latent, depth = behind.repeat(count, 1), torch.full_like(enter, scene.far)
            forward = scene.geometry == "forward"
            hit = (leave > enter) & (rays.directions[:, 2] < -MIN_FORWARD) if forward else leave > enter
            index = hit.nonzero().flatten()
            for start in range(0, len(index), RAY_CHUNK):
                check()
                part = index[start : start + RAY_CHUNK]
                skipped = (enter[part] - scene.near).clamp_min(0) * (not forward)
                origins, directions = rays[part]
                rendered = module.render_rays(Rays(origins + skipped[:, None] * directions, directions), color)
                latent[part], depth[part] = rendered.latent, rendered.depth + skipped
        outside = (depth < enter) | (depth > leave)
        latent = torch.where(outside[:, None], behind, latent)
        view = {"rgb": module.decode(latent), "latent": latent, "depth": depth.masked_fill(outside, scene.far)}
        return {name: value.float().cpu().unflatten(0, (height, width)) for name, value in view.items()}

    def picture(self, rendered: Rendered, kind: str, light: Light) -> Float[Tensor, "h w 3"]:
        return self.run.picture(rendered, kind, light)


@dataclass(frozen=True, eq=False)
class PhotographSource:
    """A photograph as a picture source: it turns with the browser's camera at its own place, and is fixed elsewhere.

    Attributes:
        label: name shown in the page.
        views, index: the photograph's view.
        background: ``[1, 3]``, colour behind transparent pixels.
    """

    label: str
    views: Views
    index: int
    background: Tensor

    @property
    def camera(self) -> BrowserCamera:
        return view_camera(self.views, self.index)

    def seen_from(self, camera: BrowserCamera) -> bool:
        """Whether a camera stands at the place where the photograph was taken."""
        eye = np.array(self.camera.position)
        return bool(np.linalg.norm(eye - camera.position) <= PHOTOGRAPH_DISTANCE * max(1.0, float(np.linalg.norm(eye))))

    def render(self, shot: Viewpoint, height: int, width: int, check: Callable[[], None]) -> Rendered:
        """Look the photograph up along a camera's rays, through its lens, ``[H, W, 3]``; black outside it."""
        camera, views, index = shot.camera, self.views, self.index
        if not self.seen_from(camera):
            camera = replace(self.camera, fov=camera.fov, aspect=camera.aspect)
        x, y, z = (camera.rays(height, width).directions @ views.c2w[index, :, :3].cpu()).unbind(1)
        u, v, ahead = x / -z, y / z, z < -1e-6
        if views.distortion is not None:
            u, v = distort(u, v, views.distortion[index].cpu())
        fx, fy, cx, cy = views.intrinsics[index].tolist()
        at = torch.stack([2 * (fx * u + cx) / views.width - 1, 2 * (fy * v + cy) / views.height - 1], dim=1)
        picture = composite(views.images[index].cpu(), self.background).permute(2, 0, 1)[None]
        sampled = F.grid_sample(picture, at.view(1, height, width, 2), padding_mode="border", align_corners=False)
        inside = (ahead & (at.abs() <= 1).all(1)).view(height, width, 1)
        return {"rgb": sampled[0].permute(1, 2, 0) * inside}

    def picture(self, rendered: Rendered, kind: str, light: Light) -> Float[Tensor, "h w 3"]:
        """The photograph lit, or as taken for the kind ``rgb``: a photograph has no latent and no depth."""
        return rendered["rgb"] if kind == "rgb" else light.apply(rendered["rgb"])


def photographs(scene: Scene, background: Float[Tensor, "1 3"]) -> list[PhotographSource]:
    """Photograph sources of the test views, then of the training views, in order of their names."""
    return [
        PhotographSource(f"{label}{name}", views, index, background)
        for label, views in (("", scene.test), ("train: ", scene.train))
        for index, name in enumerate(views.names)
    ]
