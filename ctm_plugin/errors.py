"""Errors a user can cause, each told in one message: where, what was found, what was expected."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path


class CTMError(Exception):
    """Base of every error of ours. The command line prints its message without a traceback."""


class ConfigError(CTMError):
    """A configuration key has a value that cannot be used, or is unknown.

    Example:
        >>> str(ConfigError("ctm.k", found=0, expected="an integer >= 1"))
        'ctm.k: found 0, expected an integer >= 1'
    """

    def __init__(self, key: str, found: object, expected: str):
        super().__init__(f"{key}: found {found!r}, expected {expected}")


class UnknownNameError(CTMError):
    """A name that nothing is registered under; the message lists the known ones."""

    def __init__(self, kind: str, name: object, known: Iterable[str]):
        super().__init__(f"unknown {kind} {name!r}; known: {', '.join(sorted(known))}")


class DataError(CTMError):
    """A file of a data set cannot be used."""

    def __init__(self, path: str | Path, found: object, expected: str):
        super().__init__(f"{path}: found {found}, expected {expected}")


class CheckpointError(CTMError):
    """A checkpoint or run directory cannot be used."""

    def __init__(self, path: str | Path, found: object, expected: str):
        super().__init__(f"{path}: found {found}, expected {expected}")


class DivergedError(CTMError):
    """A loss term became NaN or infinite."""

    def __init__(self, step: int, term: str, value: float, kept: str | Path):
        super().__init__(
            f"step {step}: loss term '{term}' is {value}; training stopped, last good checkpoint kept: {kept}"
        )
