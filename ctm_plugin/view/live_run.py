"""A run to look at, finished or still in training."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.backbones.pictures import PictureBackbone
from ctm_plugin.errors import CTMError
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.ndc import STEEPEST
from ctm_plugin.rays.sampling import intersect_box
from ctm_plugin.runs.load import load_posed
from ctm_plugin.runs.rundir import LAST
from ctm_plugin.scene.views import Scene
from ctm_plugin.view.look import GoOn, Rendered, Shot

CHUNK = 2048
"""Rays between two looks at whether to go on."""


class Subject:
    """A run as its last checkpoint has it, also when that is replaced.

    Args:
        folder: the run directory.
        root: the folder of its data, see :func:`ctm_plugin.runs.load.load_run`.

    Attributes:
        trouble: why the checkpoint that is there now could not be used, else empty.

    Raises:
        CTMError: see :func:`ctm_plugin.runs.load.load_posed`.
    """

    def __init__(self, folder: Path, root: str | None = None):
        self.folder, self.root, self.trouble = folder, root, ""
        self.version = self._stamp()
        self.run = load_posed(folder, root)

    @property
    def scene(self) -> Scene:
        return self.run.module.scene

    def changed(self) -> bool:
        """Whether there is another checkpoint than the one that was read last."""
        return self._stamp() not in (None, self.version)

    def refresh(self) -> None:
        """Take a new checkpoint; one that cannot be used leaves all as it is and sets ``trouble``."""
        if not self.changed():
            return
        self.version = self._stamp()
        try:
            self.run, self.trouble = load_posed(self.folder, self.root, scene=self.scene), ""
        except CTMError as error:
            self.trouble = str(error)

    def _stamp(self) -> tuple[int, ...] | None:
        try:
            stat = (self.folder / LAST).stat()
        except OSError:  # between two checkpoints there is none for a moment
            return None
        return stat.st_ino, stat.st_mtime_ns, stat.st_size

    @torch.no_grad()
    def render(self, shot: Shot, height: int, width: int, go_on: GoOn) -> Rendered | None:
        """What :meth:`ctm_plugin.runs.load.Run.picture` needs, on the CPU.

        Of a crop box: rays begin where they enter it, and those that end behind it, by their expected depth, show the
        background; so do rays that miss it. In normalised device coordinates all rays begin at the near plane, and in
        whole pictures at the camera.

        Args:
            shot: see there.
            height, width: in pixels.
            go_on: asked every ``CHUNK`` rays; ``None`` is returned when it says no. Whole pictures are too fast to ask.
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
            hit = (leave > enter) & (rays.directions[:, 2] < -STEEPEST) if forward else leave > enter
            index = hit.nonzero().flatten()
            for start in range(0, len(index), CHUNK):
                if not go_on():
                    return None
                part = index[start : start + CHUNK]
                skipped = (enter[part] - scene.near).clamp_min(0) * (not forward)
                origins, directions = rays[part]
                rendered = module.render_rays(Rays(origins + skipped[:, None] * directions, directions), color)
                latent[part], depth[part] = rendered.latent, rendered.depth + skipped
        outside = (depth < enter) | (depth > leave)
        latent = torch.where(outside[:, None], behind, latent)
        view = {"rgb": module.decode(latent), "latent": latent, "depth": depth.masked_fill(outside, scene.far)}
        return {name: value.float().cpu().unflatten(0, (height, width)) for name, value in view.items()}

    def picture(self, rendered: Rendered, kind: str, factor: float) -> Float[Tensor, "h w 3"]:
        return self.run.picture(rendered, kind, factor)
