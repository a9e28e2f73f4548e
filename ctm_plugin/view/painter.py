"""Pictures that get finer while nobody moves, for any number of clients, by one painter."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

COARSEST = 16
"""The least longer side of a picture in pixels; each is twice the one before, but for the last."""
AT_ONCE = 0.15
"""Seconds that the first picture after a movement may be expected to take."""
WORTH = 1.25
"""Times the last picture's side, below which a finer one is not painted, unless it is the finest."""
GUESS = 10_000.0
"""Pixels a second, as long as none are measured."""


class Limit(NamedTuple):
    """How fine a client's last picture becomes."""

    finest: int = 1024
    """Its longer side in pixels, >= ``COARSEST``."""
    seconds: float = 10.0
    """That it may be expected to take."""


@dataclass(frozen=True, eq=False)
class Task:
    """The next picture for a client."""

    look: Any
    limit: Limit
    size: int
    """Of the picture, its longer side in pixels."""
    shown: int = 0
    """Size of the last picture whose renderings do for this look; 0: there is none."""
    first: bool = True
    """Since the client moved. It is finished even if the client has moved on: a long movement would show nothing."""
    done: bool = False
    """There is nothing finer to paint."""


class Painter:
    """Paints what each client looks at, coarse at first, then finer and finer; the coarsest task comes first.

    How coarse and how fine follows from how long the last picture took. All methods but :meth:`work` and :meth:`step`
    return at once and may be called from any thread. A look has a method ``alike``: whether the renderings of its last
    picture do for another look, which is then as fine at once.

    Args:
        paint: makes a picture of a look, its longer side so many pixels, and tells the seconds that one takes. It asks
            its third argument now and then whether to go on, and returns ``None`` when the answer is no.
        show: gives a client a picture and the seconds.
    """

    def __init__(
        self,
        paint: Callable[[Any, int, Callable[[], bool]], tuple[Any, float] | None],
        show: Callable[[int, Any, Any, float], None],
    ):
        self._paint, self._show = paint, show
        self._tasks: dict[int, Task] = {}
        self._speed = GUESS
        self._changed = threading.Condition()
        self._closed = False

    def ask(self, client: int, look: Any, limit: Limit = Limit()) -> None:  # noqa: B008 (immutable)
        """From now on a client looks at this. Nothing is painted anew for who looks at what it looked at before."""
        with self._changed:
            before = self._tasks.get(client)
            if before is not None and (before.look, before.limit) == (look, limit):
                return
            if before is not None and before.shown and before.look.alike(look):
                size = shown = before.shown
            else:
                size, shown = COARSEST, 0
                while 2 * size <= limit.finest and (2 * size) ** 2 / self._speed <= AT_ONCE:
                    size *= 2
            self._tasks[client] = Task(look, limit, min(size, limit.finest), shown)
            self._changed.notify()

    def forget(self, client: int) -> None:
        """A client has gone."""
        with self._changed:
            self._tasks.pop(client, None)

    def repaint(self, changed: Callable[[Any], bool]) -> None:
        """Paint again, as fine as it is, what looks different now."""
        with self._changed:
            for client, task in self._tasks.items():
                if changed(task.look):
                    self._tasks[client] = replace(task, first=False, done=False)
            self._changed.notify()

    def close(self) -> None:
        """End :meth:`work`."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def work(self) -> None:
        """Paint until :meth:`close`; only in the thread that calls this."""
        while not self._closed:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._following() is not None)
            self.step()

    def step(self) -> bool:
        """Paint the next picture, and tell whether there was one."""
        with self._changed:
            following = self._following()
        if following is None or self._closed:
            return False
        client, task = following
        painted = self._paint(task.look, task.size, lambda: self._wanted(client, task))
        if painted is not None:
            self._finish(client, task, painted[1])
            self._show(client, task.look, *painted)
        return True

    def _following(self) -> tuple[int, Task] | None:
        open_ones = [(client, task) for client, task in self._tasks.items() if not task.done]
        return min(open_ones, key=lambda each: each[1].size, default=None)

    def _wanted(self, client: int, task: Task) -> bool:
        with self._changed:
            return not self._closed and (task.first or self._following() == (client, task))

    def _finish(self, client: int, task: Task, seconds: float) -> None:
        """What follows a picture: a finer one, as fine as the limits allow."""
        with self._changed:
            self._speed = task.size**2 / max(seconds, 1e-6)  # pictures have other shapes, but the same before and after
            finest = task.limit.finest
            finer = min(2 * task.size, finest, math.isqrt(int(self._speed * task.limit.seconds)))
            done = finer <= task.size or finer < min(WORTH * task.size, finest)
            if self._tasks.get(client) is task:
                size = task.size if done else finer
                self._tasks[client] = replace(task, size=size, shown=task.size, first=False, done=done)
