"""Progress on standard error: a bar for each thing that takes long, or one over all of them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

T = TypeVar("T")
Update = Callable[..., None]
"""Told how many are done, and a word on them."""


def error_console() -> Console:
    """Open standard error, where progress goes: standard output holds results."""
    return Console(file=sys.stderr)


class Whole:
    """One bar over several things, each of which has its part of the whole.

    Args:
        parts: how long each takes, in any unit, by what :func:`bar` calls it. Others change nothing.
    """

    def __init__(self, parts: Mapping[str, float]):
        names = [*parts]
        self.begun = {name: sum(parts[before] for before in names[:index]) for index, name in enumerate(names)}
        self.parts = dict(parts)
        self.progress = _progress(error_console(), TimeRemainingColumn(elapsed_when_finished=True))
        self.task = self.progress.add_task("", total=sum(parts.values()), last="")

    def update(self, what: str, share: float, last: str) -> None:
        done = None if what not in self.parts else self.begun[what] + self.parts[what] * share
        self.progress.update(self.task, completed=done, description=what, last=last)


_WHOLE: list[Whole] = []


@contextmanager
def whole(parts: Mapping[str, float]) -> Iterator[None]:
    """Show one bar for all that is done within, see :class:`Whole`."""
    _WHOLE.append(Whole(parts))
    try:
        with _WHOLE[-1].progress:
            yield
    finally:
        _WHOLE.pop()


@contextmanager
def bar(what: str, total: int, begun: int = 0, console: Console | None = None) -> Iterator[Update]:
    """Show how many of ``total`` are done, with a word on the last."""
    if _WHOLE:
        over = _WHOLE[-1]
        yield lambda number, last="": over.update(what, number / max(total, 1), last)
        return
    with _progress(
        console or error_console(), TextColumn("{task.completed:.0f}/{task.total:.0f}"), TimeRemainingColumn()
    ) as progress:
        task = progress.add_task(what, total=total, completed=begun, last="")
        yield lambda number, last="": progress.update(task, completed=number, last=last)


def tracked(items: Iterable[T], what: str, total: int | None = None) -> Iterator[T]:
    """Show how many items have been."""
    count = total if total is not None else len(items) if isinstance(items, Sequence | range) else 0
    with bar(what, count) as done:
        for number, item in enumerate(items, 1):
            yield item
            done(number)


def _progress(console: Console, *columns: ProgressColumn) -> Progress:
    columns = (TextColumn("{task.description:<10}"), BarColumn(), *columns, TimeElapsedColumn())
    last = TextColumn("{task.fields[last]}", markup=False)
    return Progress(*columns, last, console=console, transient=True, disable=not console.is_terminal)
