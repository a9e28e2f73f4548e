"""Learning-rate schedules."""

from __future__ import annotations

from collections.abc import Callable

Schedule = Callable[[int | float], float]
"""Factor on a learning rate after a number of optimizer steps; the number has parts where time stretches or cuts a
schedule."""


def exponential(factor: float, steps: int, start: int = 0) -> Schedule:
    """Make the schedule ``factor ** ((step - start) / steps)``, which reaches ``factor`` at ``start + steps``."""
    return lambda step: factor ** ((step - start) / steps)
