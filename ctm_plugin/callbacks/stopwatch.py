"""Time and memory that a training took, over all its interruptions."""

from __future__ import annotations

import resource
import sys
import time
from typing import Any

import lightning as L
import torch

from ctm_plugin.backbones.base import Backbone


class Stopwatch(L.Callback):
    """Count seconds of training (pre-training of the transform included), and the largest memory used.

    Kept in the checkpoint, so that a resumed run counts on. It stops with the last step: what comes after, saving and
    scoring, is no training, and the last checkpoint holds what ``metrics.json`` does.
    """

    def __init__(self) -> None:
        self.before = 0.0
        self.peak_memory_mb = 0.0
        self._start: float | None = None
        self._device = torch.device("cpu")

    @property
    def seconds(self) -> float:
        return self.before + (0.0 if self._start is None else time.perf_counter() - self._start)

    def on_fit_start(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        self._device = pl_module.device
        if self._device.type == "cuda":
            torch.cuda.reset_peak_memory_stats()
        if pl_module.batches_seen < pl_module.total_steps * trainer.accumulate_grad_batches:
            self._start = time.perf_counter()

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        if trainer.global_step == trainer.max_steps and self._start is not None:
            synchronise(self._device)  # a GPU is behind by some steps
            self._look()
            self.before, self._start = self.seconds, None

    def _look(self) -> None:
        self.peak_memory_mb = max(self.peak_memory_mb, peak_memory_mb(self._device))

    def state_dict(self) -> dict[str, Any]:
        if self._start is not None:
            self._look()
        return {"seconds": self.seconds, "peak_memory_mb": self.peak_memory_mb}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.before, self.peak_memory_mb = state_dict["seconds"], state_dict["peak_memory_mb"]


def synchronise(device: torch.device) -> None:
    """Wait for a GPU; elsewhere nothing is pending."""
    if device.type == "cuda":
        torch.cuda.synchronize()


def peak_memory_mb(device: torch.device) -> float:
    """Tell this process's largest memory so far, in MiB: GPU memory if ``device`` is a GPU, else resident memory.

    Resident memory counts all jobs of a process: in a sweep, a job has at least what those before it had.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated() / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)
