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
    """Weight of the parameters in the mean at its update number ``count``: ``max(4 / latest, 9 / (10 + count))``, which
    soon forgets the beginning."""
    return max(min(1.0, STEPS_BETWEEN / latest), 9 / (10 + count))


@torch.no_grad()
def follow(mean: nn.Module, trained: nn.Module, share: float) -> None:
    """Let the mean go a share of the way to what is trained; buffers are copied.

    torch's ``AveragedModel`` counts its looks on the device, which would make a GPU wait in each.
    """
    for average, parameter in zip(mean.parameters(), trained.parameters(), strict=True):
        average.lerp_(parameter, share)
    for average, buffer in zip(mean.buffers(), trained.buffers(), strict=True):
        average.copy_(buffer)


class Averaging:
    """Gives a backbone the mean of its ``field`` over ``config.averaged`` latest steps, 0 for none: ``mean_field``."""

    field: nn.Module
    mean_field: nn.Module | None
    settled = 0
    """First step at which the field has its final size."""

    @property
    def pictured_field(self) -> nn.Module:
        """The field that pictures are made with: its mean in evaluation, where there is one."""
        return self.field if self.training or self.mean_field is None else self.mean_field

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        super().on_train_batch_start(batch, batch_idx)
        if self.config.averaged and self.between_steps:
            self.average(self.global_step)

    def average(self, step: int) -> None:
        """Take the parameters before a step into their mean, if it is one of the looks."""
        averaged = self.config.averaged
        count, rest = divmod(step - max(self.settled, self.total_steps - WINDOWS * averaged), STEPS_BETWEEN)
        if count < 0 or rest:
            return
        if count == 0 or self.mean_field is None:
            self.copy_field()
        else:
            follow(self.mean_field, self.field, share(count, averaged))

    def copy_field(self) -> None:
        """Begin with a mean of the field as it is."""
        self.mean_field = deepcopy(self.field).requires_grad_(False)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Make room for the mean, where the checkpoint has one; the field must have its size already."""
        super().on_load_checkpoint(checkpoint)
        self.mean_field = None
        if any(key.startswith("mean_field.") for key in checkpoint["state_dict"]):
            self.copy_field()
