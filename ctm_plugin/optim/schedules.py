"""Learning-rate schedules."""

from __future__ import annotations

from collections.abc import Callable

Schedule = Callable[[int], float]
"""Factor on a learning rate after so many optimizer steps."""


def exponential(factor: float, steps: int, start: int = 0) -> Schedule:
    """Make the schedule ``factor ** ((step - start) / steps)``, which reaches ``factor`` at ``start + steps``."""
    return lambda step: factor ** ((step - start) / steps)
