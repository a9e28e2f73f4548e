"""A schedule that is stretched or cut while it is followed, so that a training ends on time."""

from __future__ import annotations

from bisect import bisect_left
from typing import NamedTuple


class Turn(NamedTuple):
    """A change of pace.

    Attributes:
        step: the training's step from which it holds.
        place: the schedule's step then.
        end: the training's step at which the schedule ends.
    """

    step: int
    place: float
    end: int


class Pace:
    """Position of a training in its schedule.

    The schedule has ``planned`` steps, of which learning rates and other settings know; a training follows it in more
    steps or fewer. Between turns it goes on evenly: at step s, of the turn (s0, p0, end) before it,
    ``place(s) = p0 + (planned - p0) (s - s0) / (end - s0)``. Without a turn this is s itself.

    Args:
        planned: steps of the schedule, >= 1.
        turns: changes of pace up to now, out of a checkpoint.
    """

    def __init__(self, planned: int, turns: list[tuple[int, float, int]] | None = None):
        self.planned = planned
        self.turns = [Turn(*turn) for turn in turns or [(0, 0.0, planned)]]

    @property
    def end(self) -> int:
        """Number of steps of the whole training, as the latest turn has it."""
        return self.turns[-1].end

    def place(self, step: int) -> float:
        """Give the schedule's step at a step of the training, both from 0."""
        before = max(bisect_left(self.turns, step, key=lambda turn: turn.step) - 1, 0)
        since, place, end = self.turns[before]
        return place + (self.planned - place) * (step - since) / max(end - since, 1)

    def passes(self, step: int, every: int) -> bool:
        """Tell whether the schedule comes to a multiple of ``every`` with a step; not with step 0."""
        return step > 0 and self.place(step) // every > self.place(step - 1) // every

    def end_after(self, step: int, left: int) -> None:
        """Let what is left of the schedule take so many steps after ``step``, one at least."""
        self.turns.append(Turn(step, self.place(step), step + max(left, 1)))
