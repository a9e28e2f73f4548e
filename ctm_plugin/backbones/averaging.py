"""Pictures made with the mean of a field's parameters over the latest steps (Polyak and Juditsky, 1992): the noise that
high rates leave is averaged away, so that rates may stay high."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import torch
from torch import nn

STEPS_BETWEEN = 4
"""Optimizer steps from one update of the mean to the next."""
WINDOWS = 8
"""The mean starts this many averaging windows before the end: older parameters would weigh nothing."""


def share(count: int, latest: int) -> float:
    """Weight of the present parameters in the running mean at update ``count``: ``max(4 / latest, 9 / (10 + count))``.
    The mean soon forgets the first ones."""
    return max(min(1.0, STEPS_BETWEEN / latest), 9 / (10 + count))


@torch.no_grad()
def follow(mean: nn.Module, trained: nn.Module, share: float) -> None:
    """Move the mean parameters a share of the way to the trained ones, in place; buffers are copied.

    torch's ``AveragedModel`` counts its updates on the device, which would make a GPU wait in each.
    """
    for average, parameter in zip(mean.parameters(), trained.parameters(), strict=True):
        average.lerp_(parameter, share)
    for average, buffer in zip(mean.buffers(), trained.buffers(), strict=True):
        average.copy_(buffer)


class Averaging:
    """Mixin: gives a backbone ``mean_field``, the mean of its ``field`` over the ``config.averaged`` latest steps."""

    field: nn.Module
    mean_field: nn.Module | None
    settled = 0
    """First step at which the field has its final size."""

    @property
    def pictured_field(self) -> nn.Module:
        """The field that pictures are rendered with: in evaluation the mean field, where there is one."""
        return self.field if self.training or self.mean_field is None else self.mean_field

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        super().on_train_batch_start(batch, batch_idx)
        if self.config.averaged and self.between_steps:
            self.average(self.global_step)

    def average(self, step: int) -> None:
        """Update the mean with the field's parameters before ``step``, if the mean is due for an update."""
        averaged = self.config.averaged
        count, rest = divmod(step - max(self.settled, self.total_steps - WINDOWS * averaged), STEPS_BETWEEN)
        if count < 0 or rest:
            return
        if count == 0 or self.mean_field is None:
            self.copy_field()
        else:
            follow(self.mean_field, self.field, share(count, averaged))

    def copy_field(self) -> None:
        """Start the mean as a copy of the present field."""
        self.mean_field = deepcopy(self.field).requires_grad_(False)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Make a mean field to load the checkpoint's into, if it has one; the field must have its final sizes."""
        super().on_load_checkpoint(checkpoint)
        self.mean_field = None
        if any(key.startswith("mean_field.") for key in checkpoint["state_dict"]):
            self.copy_field()
