"""A run read again from its directory: its module with its weights, and pictures of it from any camera."""

from __future__ import annotations

import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.backbones.posed import PosedBackbone
from ctm_plugin.color.light import Light
from ctm_plugin.cpu.allocator import keep_memory
from ctm_plugin.errors import CheckpointError, CTMError
from ctm_plugin.runs.assemble import Parts, assemble
from ctm_plugin.runs.cameras import CAMERAS, noted_scene
from ctm_plugin.runs.data import check_data, located, note_data
from ctm_plugin.runs.rundir import LAST, load_checkpoint, load_config
from ctm_plugin.show.pictures import depth_picture, latent_picture

KINDS = ("lit", "rgb", "latent", "depth")


@dataclass(frozen=True)
class PosedRun:
    """What a run is made of.

    Attributes:
        parts: with weights; the backbone is a :class:`PosedBackbone`.
        config: the run's.
        step: of its checkpoint.
        light: what its pictures are shown in by default.
    """

    parts: Parts
    config: dict[str, Any]
    step: int
    light: Light

    @property
    def module(self) -> PosedBackbone:
        return self.parts.backbone

    def picture(self, view: dict[str, Tensor], kind: str, light: Light | None = None) -> Float[Tensor, "h w 3"]:
        """One of :data:`KINDS` out of what :meth:`PosedBackbone.render_view` returned, on the CPU.

        ``light`` is what lit pictures are shown in; the scene's own where it is ``None``.
        """
        if kind == "depth":
            return depth_picture(view["depth"], self.module.scene.near, self.module.scene.far)
        if kind == "latent":
            return latent_picture(view["latent"])
        return (light or self.light).apply(view["rgb"]) if kind == "lit" else view["rgb"]


def load_posed(run: Path, root: str | None = None, pictures: bool = True, scene: Any = None) -> PosedRun:
    """A run as it was at its last checkpoint, ready to render; see :func:`load_run`.

    Raises:
        CTMError: the folder is no run, its checkpoint cannot be used, or it is not of a scene with cameras.
    """
    parts, config, checkpoint = load_run(run, root, pictures, scene)
    module = parts.backbone
    if not module.posed:
        raise CTMError(f"{run}: found a run of another kind, expected one of a scene that cameras look at")
    module.eval()
    return PosedRun(parts, config, checkpoint["global_step"], module.light)


def restore(parts: Parts, checkpoint: dict[str, Any], path: Path) -> None:
    """Put a checkpoint's weights into the parts that its configuration gives.

    Raises:
        CheckpointError: they do not fit, as when another version of a backbone made them.
    """
    module = parts.backbone
    module.transform = parts.attach.transform
    try:
        module.on_load_checkpoint(checkpoint)
        module.load_state_dict(checkpoint["state_dict"])
        for name, parameter in module.named_parameters():
            if not parameter.isfinite().all():
                raise ValueError(f"NaN or infinity in {name}")
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        found = f"weights that do not fit ({' '.join(str(error).split())[:200]})"
        raise CheckpointError(path, found, "those of this version's model") from error


def load_run(
    run: Path, root: str | None = None, pictures: bool = True, scene: Any = None
) -> tuple[Parts, dict[str, Any], dict[str, Any]]:
    """A run as it was at its last checkpoint: parts with weights, configuration, step and callbacks' states.

    Args:
        run: its directory.
        root: the folder of its data, where that is not found from the run; other data than it had are warned of.
        pictures: whether they are wanted; else the run's own note of its cameras does where the data are nowhere.
        scene: the run's, where it has been read already.

    Raises:
        CTMError: the folder is no run, its data are nowhere, or its checkpoint cannot be used.
    """
    keep_memory()
    config = load_config(run)
    checkpoint = load_checkpoint(run, config)
    try:
        config = located(config, run, root) if scene is None else config
    except CheckpointError:
        scene = None if pictures else noted_scene(run)
        if scene is None:
            raise
        warnings.warn(f"{run}: its photographs are gone; it goes by the cameras in {CAMERAS}", stacklevel=2)
    parts = assemble(config, scene=scene)
    if scene is None and check_data(run, parts.scene) and root is not None:
        with suppress(OSError):  # a run that may only be read
            note_data(run, config, parts.scene)  # the next command finds them
    restore(parts, checkpoint, run / LAST)
    parts.backbone.to("cuda" if torch.cuda.is_available() and parts.trainer.accelerator != "cpu" else "cpu")
    # The rest of it, weights and moments, would be held as long.
    return parts, config, {name: checkpoint[name] for name in ("global_step", "callbacks")}
