"""Values of settings that are ``auto``: decided from the capture and the machine, and printed."""

from __future__ import annotations

import sys
from contextlib import suppress
from importlib.util import find_spec
from typing import Any

from omegaconf import DictConfig, OmegaConf

from ctm_plugin.compose.checks import choice_settings
from ctm_plugin.data.capture import Capture
from ctm_plugin.data.load import Layout
from ctm_plugin.data.rig import Rig
from ctm_plugin.errors import CTMError
from ctm_plugin.files import is_main_process
from ctm_plugin.scene.kinds import AUTO, GEOMETRIES
from ctm_plugin.settings.build import build
from ctm_plugin.settings.registry import BACKBONES, DATASETS

QUICK_PIXELS = 300**2
"""Most pixels of a picture that the quick budget suits; its grids have 64 to 128 voxels a side."""


def decide(config: DictConfig) -> Capture | None:
    """Decide ``dataset.geometry``, ``trainer.budget`` and, for splats, ``trainer.accelerator`` where they are ``auto``.

    It prints a line for each decision, with the reason.

    Args:
        config: as Hydra composed it.

    Returns:
        The capture that was read to decide, so that it is not read again; ``None``: none was.
    """
    dataset, decided = OmegaConf.to_container(config.dataset, resolve=True, throw_on_missing=False), {}
    capture, rig = _read(dataset) if AUTO in (dataset.get("geometry"), config.trainer.budget) else (None, None)
    if dataset.get("geometry") == AUTO:
        among = getattr(BACKBONES.get(str(config.backbone.name)), "geometries", GEOMETRIES) if rig else GEOMETRIES
        decided["dataset.geometry"] = rig.geometry(among) if rig else ("bounded", "")
    accelerator = config.trainer.accelerator
    if accelerator == AUTO and config.backbone.name == "splat" and has_gpu() and not composites_there():
        accelerator = "cpu"
        decided["trainer.accelerator"] = accelerator, "splats on a GPU need Triton, which is not installed"
    if config.trainer.budget == AUTO:
        decided["trainer.budget"] = budget(rig, accelerator)
    for key, (value, why) in decided.items():
        OmegaConf.update(config, key, value)
        if why and is_main_process():
            print(f"{key.removesuffix('.budget')}={value}: {why}", file=sys.stderr)
    return capture


def budget(rig: Rig | None, accelerator: str) -> tuple[str, str]:
    """Choose the budget by the device and the pictures' size; give the reason in words."""
    if accelerator != "cpu" and has_gpu():
        return "standard", "there is a GPU"
    if rig is not None and rig.size[0] * rig.size[1] > QUICK_PIXELS:
        return "standard", f"pictures of {rig.size[1]}x{rig.size[0]}"
    return "quick", "small pictures, and no GPU" if rig else ""


def has_gpu() -> bool:
    """Whether torch has found a CUDA GPU."""
    import torch

    return torch.cuda.is_available()


def composites_there() -> bool:
    """Whether the GPU has kernels for splats: in plain torch splats are many times slower than by a CPU's loops."""
    return find_spec("triton") is not None


def _read(dataset: dict[str, Any]) -> tuple[Capture | None, Rig | None]:
    """Read a data set's capture and its cameras' arrangement; errors give ``None``, as building the run raises them."""
    capture = rig = None
    with suppress(CTMError):
        kind = DATASETS.get(str(dataset.get("name")))
        if isinstance(kind, type) and issubclass(kind, Layout):
            layout = build(kind, choice_settings(dataset), "dataset")
            capture = layout.capture()
            rig = layout.rig(capture)
    return capture, rig
