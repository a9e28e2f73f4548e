"""Trainings that end on time, whatever else the machine does meanwhile."""

from __future__ import annotations

from typing import Any

import lightning as L

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.callbacks.stopwatch import Stopwatch

CLOCK_CHECKS = 20
"""Number of times in a training that the schedule is compared with the clock."""
MAX_STRETCH = 4
"""Largest factor by which a schedule is stretched: more steps teach next to nothing."""
MIN_STRETCH = 0.25
"""Least factor to which a schedule is cut: with fewer steps nothing is learned."""
SYNC_STEPS = 16
"""Steps from one comparison of several processes' clocks to the next: they wait for each other."""


class Deadline(L.Callback):
    """Stretch or cut the rest of a backbone's schedule, so that the training ends after ``seconds``.

    It looks at the clock at the end of each twentieth of the time or of the schedule, whichever comes first, and takes
    the steps since the last look for those to come, weighed by :meth:`Backbone.cost`. What it decides is part of the
    backbone's checkpoint; a run that goes on has what is left of its time.

    Args:
        seconds: time limit of the training, interruptions left out.
        stopwatch: the callback that counts the seconds.
    """

    def __init__(self, seconds: float, stopwatch: Stopwatch):
        self.seconds, self.stopwatch = seconds, stopwatch

    @property
    def left(self) -> float:
        """Seconds that the training still has."""
        return max(self.seconds - self.stopwatch.seconds, 0.0)

    def on_train_start(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        self._look(trainer, pl_module)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: Backbone, *_: Any) -> None:
        together, step = trainer.world_size > 1, trainer.global_step
        if not pl_module.between_steps or step >= trainer.max_steps or (together and step % SYNC_STEPS):
            return
        # Of several processes the first one's clock counts.
        due = self._part(trainer, pl_module) > self.part
        if trainer.strategy.broadcast(due) if together else due:
            self._settle(trainer, pl_module)
            self._look(trainer, pl_module)

    def _part(self, trainer: L.Trainer, module: Backbone) -> int:
        done = module.scheduled / module.schedule_steps
        return int(CLOCK_CHECKS * max(self.stopwatch.seconds / self.seconds, done))

    def _look(self, trainer: L.Trainer, module: Backbone) -> None:
        self.part, self.step, self.spent = self._part(trainer, module), trainer.global_step, self.stopwatch.seconds

    def _settle(self, trainer: L.Trainer, module: Backbone) -> None:
        step, pace = trainer.global_step, module.pace
        here, before = pace.place(step), pace.place(self.step)
        each = (self.stopwatch.seconds - self.spent) / (step - self.step) / module.cost(before, here)
        steps = self.left / (each * module.cost(here, pace.planned))
        least, stretched = (share * (pace.planned - here) for share in (MIN_STRETCH, MAX_STRETCH))
        pace.end_after(step, round(min(max(trainer.strategy.broadcast(steps), least), stretched)))
        trainer.fit_loop.epoch_loop.max_steps = pace.end
