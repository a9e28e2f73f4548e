"""One precision for all scores: a run trained in half precision or TF32 is scored like any other."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def full_float32(device: torch.device) -> Iterator[None]:
    """Context in which convolutions on ``device`` run in plain float32: no autocast, no TF32, deterministic kernels.

    SSIM subtracts nearly equal moments, and TF32's ten bits do not survive that.
    """
    with (
        torch.autocast(device.type, enabled=False),
        torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False),
    ):
        yield
