"""Progress on standard error: a bar for each thing that takes long, or one over all of them."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

T = TypeVar("T")
Update = Callable[..., None]
"""Function called with the number of items done, a word on them, and the seconds left where they are known."""
SMOOTHING_S = 20.0
"""Seconds over which a new guess of the end replaces an old one."""


def error_console() -> Console:
    """Open standard error, where progress goes: standard output holds results."""
    return Console(file=sys.stderr)


class Whole:
    """One progress bar over several tasks, each of which has its part of the whole.

    Args:
        parts: planned seconds of each task, by its name in :func:`bar`. Tasks of other names do not move the bar.

    The time left of a part goes from the planned to the measured time as the part goes on; later parts count with
    their planned time.
    """

    def __init__(self, parts: Mapping[str, float]):
        names = [*parts]
        self.begun = {name: sum(parts[before] for before in names[:index]) for index, name in enumerate(names)}
        self.parts = dict(parts)
        self.progress = _progress(error_console(), TextColumn("{task.fields[eta]}"))
        self.task = self.progress.add_task("", total=sum(parts.values()), last="", eta="")
        self.here, self.since, self.told, self.end = "", 0.0, None, 0.0

    def update(self, what: str, share: float, last: str, left: float | None = None) -> None:
        if what not in self.parts:
            self.progress.update(self.task, description=what, last=last)
            return
        now, planned, total = time.monotonic(), self.parts[what], sum(self.parts.values())
        if what != self.here:
            self.here, self.since = what, now
        if left is None:
            left = planned * (1 - share) ** 2 + (now - self.since) * (1 - share)
        end = now + left + total - self.begun[what] - planned
        self.end = end if self.told is None else self.end + (end - self.end) * min((now - self.told) / SMOOTHING_S, 1.0)
        self.told = now
        eta = f"{timedelta(seconds=round(max(self.end - now, 0)))} left"
        done = self.begun[what] + planned * share
        self.progress.update(self.task, completed=done, description=what, last=last, eta=eta)


_WHOLE: list[Whole] = []


@contextmanager
def whole(parts: Mapping[str, float]) -> Iterator[None]:
    """Context with one progress bar over all tasks within, see :class:`Whole`."""
    _WHOLE.append(Whole(parts))
    try:
        with _WHOLE[-1].progress:
            yield
    finally:
        _WHOLE.pop()


@contextmanager
def bar(what: str, total: int, begun: int = 0, console: Console | None = None) -> Iterator[Update]:
    """Context with a progress bar of ``total`` items; it gives the function that updates the bar."""
    if _WHOLE:
        over = _WHOLE[-1]
        yield lambda number, last="", left=None: over.update(what, number / max(total, 1), last, left)
        return
    with _progress(
        console or error_console(), TextColumn("{task.completed:.0f}/{task.total:.0f}"), TimeRemainingColumn()
    ) as progress:
        task = progress.add_task(what, total=total, completed=begun, last="")
        yield lambda number, last="", left=None: progress.update(task, completed=number, last=last)


def say(text: str) -> None:
    """Print a line on standard error, above a bar over several things."""
    console = _WHOLE[-1].progress.console if _WHOLE else error_console()
    console.print(text, soft_wrap=True, highlight=False, markup=False)


def tracked(items: Iterable[T], what: str, total: int | None = None) -> Iterator[T]:
    """Iterate over items under a progress bar."""
    count = total if total is not None else len(items) if isinstance(items, Sequence | range) else 0
    with bar(what, count) as done:
        for number, item in enumerate(items, 1):
            yield item
            done(number)


def _progress(console: Console, *columns: ProgressColumn) -> Progress:
    columns = (TextColumn("{task.description:<10}"), BarColumn(), *columns, TimeElapsedColumn())
    last = TextColumn("{task.fields[last]}", markup=False)
    return Progress(*columns, last, console=console, transient=True, disable=not console.is_terminal)
