"""Checks of configuration values, which raise :class:`ConfigError`."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection

from ctm_plugin.errors import ConfigError

Number = float | int
"""What a configuration file may hold for a real number: ``exposure: 1`` is an int."""


def is_number(value: object) -> bool:
    """Tell whether ``value`` is an int or a float; bools are not numbers here."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def check_number(key: str, value: object, allowed: Callable[[Number], bool], expected: str) -> None:
    """Refuse what is not a number or not ``allowed``, a bounded interval written as comparisons (NaN then fails them).

    Raises:
        ConfigError: its message names ``key``.
    """
    if not is_number(value) or not allowed(value):
        raise ConfigError(key, value, expected)


def check_integer(key: str, value: object, low: int, high: int = 2**31 - 1) -> None:
    """Refuse what is not an integer from ``low`` to ``high``.

    Raises:
        ConfigError: its message names ``key``.
    """
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise ConfigError(key, value, f"an integer >= {low}" if high == 2**31 - 1 else f"an integer, {low} to {high}")


def check_least(key: str, value: Number, least: Number | None = None) -> None:
    """Refuse what is below ``least``, or infinite or NaN; without ``least`` integers below 1 and other numbers <= 0.

    Raises:
        ConfigError: its message names ``key``.
    """
    least = 1 if least is None and isinstance(value, int) else least
    if not (value > 0 if least is None else value >= least) or not math.isfinite(value):
        raise ConfigError(key, value, "a number > 0" if least is None else f"a number >= {least}")


def check_square(key: str, value: object) -> None:
    """Refuse what is not the square of a positive integer.

    Raises:
        ConfigError: its message names ``key``.
    """
    if not isinstance(value, int) or isinstance(value, bool) or value < 1 or math.isqrt(value) ** 2 != value:
        raise ConfigError(key, value, "a square number: 1, 4, 9, ...")


def check_choice(key: str, value: object, choices: Collection[str]) -> None:
    """Refuse what is not one of ``choices``.

    Raises:
        ConfigError: its message names ``key``.
    """
    if not isinstance(value, str) or value not in choices:
        raise ConfigError(key, value, f"one of {', '.join(choices)}")
