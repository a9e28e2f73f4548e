"""Stop a run whose loss is no number, naming the step and the term."""

from __future__ import annotations

import math
from pathlib import Path

import lightning as L
import torch
from torch import Tensor

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.errors import DivergedError


class FiniteLoss(L.Callback):
    """Check every loss term of every step before its gradients are used, and all parameters before they are saved.

    On the CPU the check is immediate. On a GPU the values travel to the host during the computation and are read one
    step later, so that no step waits; a checkpoint is never written before they are read. Several processes check the
    sums of their values, so that they stop together.

    Args:
        kept: file of the last good checkpoint, for the message.
    """

    def __init__(self, kept: Path):
        self.kept = kept
        self._pending: tuple[int, list[str], Tensor, torch.cuda.Event | None] | None = None

    def on_before_backward(self, trainer: L.Trainer, pl_module: Backbone, loss: Tensor) -> None:
        self.check()
        terms = pl_module.terms  # not ``loss``, which a gradient scaler has scaled
        values = torch.stack([value.float() for value in terms.values()])
        if trainer.world_size > 1:
            values = trainer.strategy.reduce(values, reduce_op="sum")
        event = None
        if values.is_cuda:
            host = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
            values = host.copy_(values, non_blocking=True)
            event = torch.cuda.Event()
            event.record()
        self._pending = (trainer.global_step, list(terms), values, event)
        if event is None:
            self.check()

    def on_save_checkpoint(self, trainer: L.Trainer, pl_module: Backbone, checkpoint: dict) -> None:
        self.check()
        for name, parameter in pl_module.named_parameters():
            if not bool(parameter.isfinite().all()):  # finite losses may have gradients that are not
                raise DivergedError(trainer.global_step, f"parameter '{name}'", math.nan, self.kept)

    def check(self) -> None:
        """Read the loss values that are on their way from the device.

        Raises:
            DivergedError: a term is NaN or infinite.
        """
        if self._pending is None:
            return
        step, names, values, event = self._pending
        self._pending = None
        if event is not None:
            event.synchronize()
        for name, value in zip(names, values.tolist(), strict=True):
            if not math.isfinite(value):
                raise DivergedError(step, f"loss term '{name}'", value, self.kept)
