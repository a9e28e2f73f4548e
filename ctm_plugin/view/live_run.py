"""A run to look at, finished or still in training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.errors import CheckpointError
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.ndc import STEEPEST
from ctm_plugin.runs.load import load_posed, restore
from ctm_plugin.runs.rundir import LAST, load_checkpoint
from ctm_plugin.scene.views import Scene
from ctm_plugin.view.camera import Camera

CHUNK = 2048
"""Rays between two looks at whether to go on."""


class Subject:
    """A run as its last checkpoint has it, also when that is replaced.

    Args:
        folder: the run directory.

    Attributes:
        trouble: why the checkpoint that is there now could not be used, else empty.

    Raises:
        CTMError: see :func:`ctm_plugin.runs.load.load_posed`.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.trouble = ""
        self._stamp = self._stamp_now()
        self.run = load_posed(folder)

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

    @torch.no_grad()
    def paint(
        self, camera: Camera, kind: str, longest: int, go_on: Callable[[], bool], factor: float | None = None
    ) -> Float[Tensor, "h w 3"] | None:
        """What a camera sees, as one of :data:`ctm_plugin.runs.load.KINDS`, on the CPU.

        Args:
            camera: anywhere.
            kind: of picture.
            longest: side in pixels.
            go_on: asked every ``CHUNK`` rays; ``None`` is returned when it says no.
            factor: lifts what is lifted; ``None``: the scene's own.
        """
        module = self.run.module
        height, width = camera.size(longest)
        rays = Rays(*(part.to(module.device) for part in camera.rays(height, width)))
        latent = module.transform.encode(module.constant_background()).repeat(height * width, 1)
        depth = torch.full_like(latent[:, 0], self.scene.far)
        index = renderable(rays, self.scene)
        for start in range(0, len(index), CHUNK):
            if not go_on():
                return None
            part = index[start : start + CHUNK]
            rendered = module.render_rays(rays[part])
            latent[part], depth[part] = rendered.latent, rendered.depth
        view = {"rgb": module.decode(latent), "latent": latent, "depth": depth}
        view = {name: value.float().cpu().unflatten(0, (height, width)) for name, value in view.items()}
        return self.run.picture(view, kind, factor)


def renderable(rays: Rays, scene: Scene) -> Tensor:
    """Indices ``[M]`` of the rays that can be rendered: in normalised device coordinates those that go forward."""
    index = torch.arange(len(rays.origins), device=rays.origins.device)
    return index[rays.directions[:, 2] < -STEEPEST] if scene.geometry == "forward" else index
