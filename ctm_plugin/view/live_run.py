"""A run to look at, finished or still in training."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.backbones.pictures import PictureBackbone
from ctm_plugin.errors import CheckpointError
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.ndc import STEEPEST
from ctm_plugin.rays.sampling import intersect_box
from ctm_plugin.runs.load import load_posed, restore
from ctm_plugin.runs.rundir import LAST, load_checkpoint
from ctm_plugin.scene.views import Scene
from ctm_plugin.view.look import GoOn, Rendered, Shot, Source

CHUNK = 2048
"""Rays between two looks at whether to go on."""


class Subject(Source):
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
        self.folder = folder
        self.trouble = ""
        self._stamp = self._stamp_now()
        self.run = load_posed(folder, root)

    @property
    def scene(self) -> Scene:
        return self.run.module.scene

    def changed(self) -> bool:
        """Whether there is another checkpoint than the one that was read last."""
        return self._stamp_now() not in (None, self._stamp)

    def refresh(self) -> None:
        """Take a new checkpoint's weights; one that cannot be used leaves all as it is and sets ``trouble``."""
        if not self.changed():
            return
        self._stamp = self._stamp_now()
        try:
            checkpoint = load_checkpoint(self.folder, self.run.config)
            self._restore(checkpoint)
        except CheckpointError as error:
            self.trouble = str(error)
        else:
            self.run, self.trouble = replace(self.run, step=checkpoint["global_step"]), ""

    def _restore(self, checkpoint: dict[str, Any]) -> None:
        """All weights, or none: those that do not fit are found when others are in their places already."""
        module, path = self.run.module, self.folder / LAST
        before: dict[str, Any] = {"state_dict": {key: value.clone() for key, value in module.state_dict().items()}}
        module.on_save_checkpoint(before)
        try:
            restore(self.run.parts, checkpoint, path)
        except CheckpointError:
            restore(self.run.parts, before, path)
            raise
        finally:
            module.eval()

    def _stamp_now(self) -> tuple[int, ...] | None:
        try:
            stat = (self.folder / LAST).stat()
        except OSError:  # between two checkpoints there is none for a moment
            return None
        return stat.st_ino, stat.st_mtime_ns, stat.st_size

    @property
    def version(self) -> tuple[int, ...] | None:
        return self._stamp

    @torch.no_grad()
    def render(self, shot: Shot, height: int, width: int, go_on: GoOn) -> Rendered | None:
        """What :meth:`ctm_plugin.runs.load.PosedRun.picture` needs, on the CPU.

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
        if isinstance(module, PictureBackbone):
            return self._whole(module, shot, height, width, module.transform.encode(color))
        rays = Rays(*(part.to(module.device) for part in shot.camera.rays(height, width)))
        latent = module.transform.encode(color).repeat(height * width, 1)
        depth = torch.full_like(latent[:, 0], scene.far)
        index = renderable(rays, scene)
        for start in range(0, len(index), CHUNK):
            if not go_on():
                return None
            part = index[start : start + CHUNK]
            enter, leave = span(rays[part], shot.crop)
            hit = leave > enter
            if not hit.any():
                continue
            part, enter, leave = part[hit], enter[hit], leave[hit]
            skipped = torch.zeros_like(enter) if scene.geometry == "forward" else (enter - scene.near).clamp_min(0)
            origins, directions = rays[part]
            rendered = module.render_rays(Rays(origins + skipped[:, None] * directions, directions), color)
            ends = rendered.depth + skipped
            inside = (ends >= enter) & (ends <= leave)
            latent[part[inside]], depth[part[inside]] = rendered.latent[inside], ends[inside]
        return self._decoded(latent, depth, height, width)

    def _whole(self, module: PictureBackbone, shot: Shot, height: int, width: int, behind: Tensor) -> Rendered:
        """One picture before a latent ``[1, k]``, of a crop box what ends inside of it."""
        picture = module.render(shot.camera.views(height, width), 0, behind, None)
        latent, depth = picture.latent.flatten(0, 1), picture.depth.flatten()
        if shot.crop is not None:
            rays = Rays(*(part.to(module.device) for part in shot.camera.rays(height, width)))
            enter, leave = span(rays, shot.crop)
            outside = (depth < enter) | (depth > leave)
            latent = torch.where(outside[:, None], behind, latent)
            depth = depth.masked_fill(outside, self.scene.far)
        return self._decoded(latent, depth, height, width)

    def _decoded(self, latent: Tensor, depth: Tensor, height: int, width: int) -> Rendered:
        view = {"rgb": self.run.module.decode(latent), "latent": latent, "depth": depth}
        return {name: value.float().cpu().unflatten(0, (height, width)) for name, value in view.items()}

    def picture(self, rendered: Rendered, kind: str, factor: float) -> Float[Tensor, "h w 3"]:
        return self.run.picture(rendered, kind, factor)


def span(rays: Rays, crop: tuple[tuple[float, ...], ...] | None) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave a box given by two corners, ``[R]`` each, ``leave <= enter`` of those that miss it;
    0 and infinity without one."""
    if crop is None:
        return torch.zeros_like(rays.origins[:, 0]), torch.full_like(rays.origins[:, 0], math.inf)
    return intersect_box(rays, rays.origins.new_tensor(crop), 0.0, math.inf)


def renderable(rays: Rays, scene: Scene) -> Tensor:
    """Indices ``[M]`` of the rays that can be rendered: in normalised device coordinates those that go forward."""
    index = torch.arange(len(rays.origins), device=rays.origins.device)
    return index[rays.directions[:, 2] < -STEEPEST] if scene.geometry == "forward" else index
