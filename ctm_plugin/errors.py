"""Errors a user can cause, each with one message: where, what was found, what was expected."""

from __future__ import annotations

import shlex
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

MAX_CHARACTERS = 600
"""Most characters of a value in a message: the value may be a whole file."""


def printable(what: object) -> str:
    """Text of a value in one line: control characters escaped, long text cut in the middle."""
    text = "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in str(what))
    return text if len(text) <= MAX_CHARACTERS else f"{text[: MAX_CHARACTERS // 2]}...{text[-MAX_CHARACTERS // 2 :]}"


class CTMError(Exception):
    """Base of every error of ours. The command line prints its message without a traceback."""


class Words(str):
    """Description of what was found, as against a value: a message shows it without quotes."""

    __repr__ = str.__str__


class ConfigError(CTMError):
    """A configuration key has a value that cannot be used, or is unknown.

    Example:
        >>> str(ConfigError("ctm.k", found=0, expected="an integer >= 1"))
        'ctm.k: found 0, expected an integer >= 1'
    """

    def __init__(self, key: str, found: object, expected: str):
        super().__init__(f"{printable(key)}: found {printable(repr(found))}, expected {printable(expected)}")


class UnknownNameError(CTMError):
    """A name that nothing is registered under; the message lists the known ones."""

    def __init__(self, kind: str, name: object, known: Iterable[str]):
        super().__init__(f"unknown {kind} {printable(repr(name))}; known: {', '.join(sorted(known))}")


class FileError(CTMError):
    """A file or folder cannot be used."""

    def __init__(self, path: str | Path, found: object, expected: str):
        super().__init__(f"{printable(path)}: found {printable(found)}, expected {printable(expected)}")


class DataError(FileError):
    """A file of a data set cannot be used."""


class CheckpointError(FileError):
    """A checkpoint or run directory cannot be used."""


class DivergedError(CTMError):
    """A loss term or a parameter became NaN or infinite."""

    def __init__(self, step: int, what: str, value: float, kept: Path):
        last = kept if kept.exists() else "none yet"
        super().__init__(f"step {step}: {what} is {value}; training stopped, last good checkpoint kept: {last}")


class Interrupted(CTMError):
    """A run was asked to stop; what it had is saved.

    Attributes:
        when: words for the point at which the run stopped.
        by: number of the signal that asked.
    """

    def __init__(self, when: str, run: Path, by: int = signal.SIGINT):
        self.when, self.by = f"stopped {when}", by
        super().__init__(f"{self.when}; go on with: python -m ctm_plugin resume={shlex.quote(str(run))}")


@contextmanager
def handling(handler: Callable[[int, Any], None] | signal.Handlers, *numbers: int) -> Iterator[dict[int, Any]]:
    """Context that calls ``handler`` on signals; it gives the previous handlers. Only the main thread meets signals."""
    main = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, handler) for number in numbers} if main else {}
    try:
        yield before
    finally:
        for number, each in before.items():
            signal.signal(number, each)


@contextmanager
def held_interrupt() -> Iterator[None]:
    """Hold Ctrl-C back until the block is done.

    Raises:
        KeyboardInterrupt: it was pressed meanwhile.
    """
    pressed: list[int] = []
    with handling(lambda number, frame: pressed.append(number), signal.SIGINT):
        yield
    if pressed:
        raise KeyboardInterrupt
