"""A run of a scene that cameras look at, and the pictures of it that people are shown."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ctm_plugin.assemble import Parts
from ctm_plugin.backbones.radiance import RadianceBackbone
from ctm_plugin.errors import CTMError
from ctm_plugin.evaluate import load_run
from ctm_plugin.metrics.enhance import enhancement_gain, lift
from ctm_plugin.pictures import depth_picture, latent_picture

KINDS = ("rgb", "lifted", "latent", "depth")


@dataclass(frozen=True)
class PosedRun:
    """What a run is made of.

    Attributes:
        parts: with weights; the backbone is a :class:`RadianceBackbone`.
        config: the run's.
        step: of its checkpoint.
        gain: what lifts its pictures, see :func:`ctm_plugin.metrics.enhance.enhancement_gain`; 1 or less: not dark.
    """

    parts: Parts
    config: dict[str, Any]
    step: int
    gain: float

    @property
    def module(self) -> RadianceBackbone:
        return self.parts.backbone

    def picture(self, view: dict[str, Tensor], kind: str) -> Float[Tensor, "h w 3"]:
        """One of :data:`KINDS` out of what :meth:`RadianceBackbone.render_view` returned, on the CPU."""
        if kind == "depth":
            return depth_picture(view["depth"], self.module.scene.near, self.module.scene.far)
        if kind == "latent":
            return latent_picture(view["latent"])
        return lift(view["rgb"], self.gain) if kind == "lifted" else view["rgb"]


def load_posed(run: Path) -> PosedRun:
    """A run as it was at its last checkpoint, ready to render.

    Raises:
        CTMError: the folder is no run, its checkpoint cannot be used, or it is not of a scene with cameras.
    """
    parts, config, checkpoint = load_run(run)
    module = parts.backbone
    if not module.posed:
        raise CTMError(f"{run}: found a run of another kind, expected one of a scene that cameras look at")
    module.eval()
    gain = enhancement_gain(module.targets(), module.scene.exposure)
    return PosedRun(parts, config, checkpoint["global_step"], gain)
