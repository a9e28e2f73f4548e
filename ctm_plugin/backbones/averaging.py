"""Pictures made with the mean of a field's parameters over the latest steps (Polyak and Juditsky, 1992): the noise that
high rates leave is averaged away, so that rates may stay high."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn

EVERY = 4
"""Steps from one look at the parameters to the next."""
REACH = 8
"""The mean begins so many times the latest steps before the end: of what was before them nothing would be left."""


def share(count: int, latest: int) -> float:
    """What of the mean the parameters make up at its look number ``count``: ``max(4 / latest, 9 / (10 + count))``, by
    which the beginning is soon forgotten."""
    return max(min(1.0, EVERY / latest), 9 / (10 + count))


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
    """Gives a backbone means of its ``averaged_parts``, modules by name: ``mean_NAME`` for each, once there is one.

    It says by ``averaged`` of how many latest steps they are, 0 for none, and by ``settled`` from which step on the
    parts have the sizes of the end.
    """

    averaged_parts: tuple[str, ...] = ("field",)
    settled = 0

    @property
    def averaged(self) -> int:
        return self.config.averaged

    def shown(self, part: str) -> nn.Module:
        """The part that pictures are made with: its mean in evaluation, where there is one."""
        mean = getattr(self, f"mean_{part}", None)
        return getattr(self, part) if self.training or mean is None else mean

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        super().on_train_batch_start(batch, batch_idx)
        if self.averaged and self.between_steps:
            self.average(self.global_step)

    def average(self, step: int) -> None:
        """Take the parameters before a step into their means, if it is one of the looks."""
        count, rest = divmod(step - max(self.settled, self.total_steps - REACH * self.averaged), EVERY)
        if count < 0 or rest:
            return
        for part in self.averaged_parts:
            trained, mean = getattr(self, part), getattr(self, f"mean_{part}", None)
            if count == 0 or mean is None:
                setattr(self, f"mean_{part}", copied(trained))
            else:
                follow(mean, trained, share(count, self.averaged))

    def make_means(self, state: dict[str, Tensor]) -> None:
        """Make room for the means that a checkpoint has, ``state`` by name, ``[...]`` each; the parts must have their
        sizes already.
        """
        for part in self.averaged_parts:
            name = f"mean_{part}"
            there = any(key.startswith(f"{name}.") for key in state)
            setattr(self, name, copied(getattr(self, part)) if there else None)


def copied(module: nn.Module) -> nn.Module:
    """A copy that nothing trains."""
    return deepcopy(module).requires_grad_(False)
