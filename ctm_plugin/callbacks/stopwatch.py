"""What a training took, over all its interruptions."""

from __future__ import annotations

import resource
import sys
import time
from typing import Any

import lightning as L
import torch

from ctm_plugin.backbones.base import Backbone


class Stopwatch(L.Callback):
    """Seconds of training (pre-training of the transform included), and the largest memory seen.

    Kept in the checkpoint, so that a resumed run counts on.
    """

    def __init__(self) -> None:
        self.before = 0.0
        self.peak_memory_mb = 0.0
        self._start: float | None = None

    @property
    def seconds(self) -> float:
        return self.before + (0.0 if self._start is None else time.perf_counter() - self._start)

    def on_fit_start(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        self._start = time.perf_counter()

    def on_fit_end(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        self.before, self._start = self.seconds, None

    def state_dict(self) -> dict[str, Any]:
        self.peak_memory_mb = max(self.peak_memory_mb, peak_memory_mb())
        return {"seconds": self.seconds, "peak_memory_mb": self.peak_memory_mb}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.before = state_dict["seconds"]
        self.peak_memory_mb = state_dict["peak_memory_mb"]


def peak_memory_mb() -> float:
    """Largest memory of this process so far, in MiB: the GPU's where there is one, else resident memory."""
    if torch.cuda.is_available():
        return torch.cuda.max_memory_allocated() / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)
