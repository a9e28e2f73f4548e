"""What a configuration leaves to the program, ``auto``: found from the capture and the machine, and said."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from typing import Any

from omegaconf import DictConfig, OmegaConf

from ctm_plugin.data.rig import Rig
from ctm_plugin.data.settings import PhotoConfig
from ctm_plugin.errors import CTMError
from ctm_plugin.runs.checks import own
from ctm_plugin.runs.processes import is_main_process
from ctm_plugin.scene.kinds import AUTO_GEOMETRY, GEOMETRIES
from ctm_plugin.settings.build import build
from ctm_plugin.settings.registry import BACKBONES, DATASETS

QUICK_PIXELS = 300**2
"""Most pixels of a picture that the quick budget suits; its grids have 64 to 128 voxels a side."""


def decide(config: DictConfig, told: bool = True) -> dict[str, str]:
    """Find ``dataset.geometry``, ``trainer`` and, for splats, ``trainer.accelerator`` where they are ``auto``.

    Args:
        config: as Hydra composed it.
        told: whether a line is printed for each, with the reason.

    Returns:
        What to compose it again with.
    """
    dataset, decided = OmegaConf.to_container(config.dataset, resolve=True, throw_on_missing=False), {}
    rig = _rig(dataset) if AUTO_GEOMETRY in (dataset.get("geometry"), config.trainer.budget) else None
    if dataset.get("geometry") == AUTO_GEOMETRY:
        decided["dataset.geometry"] = ("bounded", "") if rig is None else rig.geometry(_among(config.backbone.name))
    accelerator = config.trainer.accelerator
    if accelerator == AUTO_GEOMETRY and config.backbone.name == "splat" and has_gpu() and not composites_there():
        accelerator = "cpu"
        decided["trainer.accelerator"] = accelerator, "splats on a GPU need Triton or gsplat, and neither is installed"
    if config.trainer.budget == AUTO_GEOMETRY:
        decided["trainer"] = budget(rig, accelerator)
    if told and is_main_process():
        for key, (value, why) in decided.items():
            if why:
                print(f"{key}={value}: {why}", file=sys.stderr)
    return {key: value for key, (value, _) in decided.items()}


def budget(rig: Rig | None, accelerator: str) -> tuple[str, str]:
    """Choose the budget by the device and the pictures' size, and say why."""
    if accelerator != "cpu" and has_gpu():
        return "standard", "there is a GPU"
    if rig is not None and rig.size[0] * rig.size[1] > QUICK_PIXELS:
        return "standard", f"pictures of {rig.size[1]}x{rig.size[0]}"
    return "quick", "small pictures, and no GPU" if rig else ""


def has_gpu() -> bool:
    """Whether torch has found one."""
    import torch

    return torch.cuda.is_available()


def composites_there() -> bool:
    """Whether a GPU has kernels for splats: by plain torch they are many times slower than by a processor's loops."""
    return any(find_spec(name) for name in ("triton", "gsplat"))


def _rig(dataset: dict[str, Any]) -> Rig | None:
    with suppress(CTMError):  # raised when the run is built
        kind = DATASETS.get(str(dataset.get("name")))
        if isinstance(kind, type) and issubclass(kind, PhotoConfig):
            return build(kind, own(dataset), "dataset").rig()  # errors are raised when the data are loaded
    return None


def _among(backbone: Any) -> Sequence[str]:
    with suppress(CTMError):
        return getattr(BACKBONES.get(str(backbone)), "geometries", GEOMETRIES)
    return GEOMETRIES
