"""Origin of a result: data, versions, code."""

from __future__ import annotations

import hashlib
import platform
import subprocess
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ctm_plugin import __version__

PACKAGES = ("torch", "lightning", "numpy", "hydra-core", "omegaconf", "torchmetrics", "scikit-image", "imageio")
"""Packages whose versions ``metrics.json`` records."""


def fingerprint(data: Any) -> str:
    """Hash a data set as it was loaded, by BLAKE2b: dataclasses, tensors, arrays, containers, plain values.

    Two data sets with one fingerprint hold the same pixels, cameras, bounds and settings, wherever their files lie. All
    bits count: where loading computes cameras or pixels, another kind of processor may give another fingerprint.
    """
    digest = hashlib.blake2b(digest_size=16)
    _add(digest, data)
    return digest.hexdigest()


def fingerprints(data: Any, above: str = "") -> dict[str, str]:
    """Hash each part of a data set by itself, as :func:`fingerprint` does, by dotted names of dataclasses' fields."""
    if not is_dataclass(data):
        return {above.rstrip("."): fingerprint(data)}
    parts = [field.name for field in fields(data) if "derived" not in field.metadata]
    return {key: text for name in parts for key, text in fingerprints(getattr(data, name), f"{above}{name}.").items()}


def _add(digest: Any, value: Any) -> None:
    if isinstance(value, Tensor):
        digest.update(f"{value.dtype}{tuple(value.shape)}".encode())
        digest.update(value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().data)
    elif isinstance(value, np.ndarray):
        digest.update(f"{value.dtype}{value.shape}".encode())
        digest.update(value.tobytes())
    elif isinstance(value, Mapping):
        _add(digest, sorted(value.items(), key=lambda item: str(item[0])))
    elif is_dataclass(value):
        for field in fields(value):
            if "derived" in field.metadata:
                continue
            if (given := getattr(value, field.name)) is not None or "added" not in field.metadata:
                digest.update(f"{field.name}=".encode())
                _add(digest, given)
    elif isinstance(value, list | tuple):
        digest.update(f"[{len(value)}".encode())
        for each in value:
            _add(digest, each)
    else:
        digest.update(f"{value!r};".encode())


@cache
def versions() -> dict[str, str]:
    """Find the versions of Python and of the packages that numbers depend on."""
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


def device_name(device: torch.device) -> str:
    """Name of a device: ``CPU``, or the GPU's model."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type.upper()


@cache
def code_version() -> str:
    """Tell the package's version; in a git checkout also its commit, with ``+`` where files have been changed since."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return __version__
    commands = (["git", "rev-parse", "--short=12", "HEAD"], ["git", "status", "--porcelain", "--untracked-files=no"])
    try:
        commit, changed = (
            subprocess.run(command, cwd=root, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
            for command in commands
        )
    except (OSError, subprocess.SubprocessError):
        return __version__
    return f"{__version__} {commit}{'+' if changed else ''}"
