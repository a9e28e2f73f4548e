"""Pictures that get finer while nobody moves, for any number of clients, by one painter."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, NamedTuple, TypeVar

COARSEST = 16
"""The least longer side of a picture in pixels; each is twice the one before, but for the last."""
AT_ONCE = 0.15
"""Seconds that the first picture after a movement may be expected to take."""
WORTH = 1.25
"""Times the last picture's side, below which a finer one is not painted, unless it is the finest."""
GUESS = 10_000.0
"""Pixels a second, as long as none are measured."""

Look, Picture = TypeVar("Look"), TypeVar("Picture")


class Limit(NamedTuple):
    """How fine a client's last picture becomes.

    Attributes:
        finest: its longer side in pixels, >= ``COARSEST``.
        seconds: that it may be expected to take.
    """

    finest: int = 1024
    seconds: float = 10.0


@dataclass(frozen=True, eq=False)
class Task(Generic[Look]):
    """The next picture for a client.

    Attributes:
        look: what is looked at.
        limit: how finely.
        size: of the picture, its longer side in pixels.
        shown: size of the last picture whose renderings do for this look; 0: there is none.
        first: since the client moved. It is finished and shown even if the client has moved on, who would see nothing
            of a long movement otherwise.
        done: there is nothing finer to paint.
    """

    look: Look
    limit: Limit
    size: int
    shown: int = 0
    first: bool = True
    done: bool = False


class Painter(Generic[Look, Picture]):
    """Paints what each client looks at, coarse at first, then finer and finer; the coarsest task comes first.

    How coarse and how fine follows from how long the last picture took. All methods but :meth:`work` and :meth:`step`
    return at once and may be called from any thread.

    Args:
        prepare: does what a look needs before its picture is begun, whose time it is not.
        paint: makes a picture of a look, its longer side so many pixels, and tells the seconds that one takes. It asks
            its third argument now and then whether to go on, and returns ``None`` when the answer is no.
        show: gives a client a picture and the seconds.
        alike: whether the last picture's renderings do for another look, which is then as fine at once.
    """

    def __init__(
        self,
        prepare: Callable[[Look], None],
        paint: Callable[[Look, int, Callable[[], bool]], tuple[Picture, float] | None],
        show: Callable[[int, Look, Picture, float], None],
        alike: Callable[[Look, Look], bool],
    ):
        self._prepare, self._paint, self._show, self._alike = prepare, paint, show, alike
        self._tasks: dict[int, Task[Look]] = {}
        self._speed = GUESS
        self._changed = threading.Condition()
        self._closed = False

    def ask(self, client: int, look: Look, limit: Limit = Limit()) -> None:  # noqa: B008 (immutable)
        """From now on a client looks at this. Nothing is painted anew for who looks at what it looked at before."""
        with self._changed:
            before = self._tasks.get(client)
            if before is not None and (before.look, before.limit) == (look, limit):
                return
            if before is not None and before.shown and self._alike(before.look, look):
                size = shown = before.shown
            else:
                size, shown = COARSEST, 0
                while 2 * size <= limit.finest and self._expected(2 * size) <= AT_ONCE:
                    size *= 2
            self._tasks[client] = Task(look, limit, min(size, limit.finest), shown)
            self._changed.notify()

    def forget(self, client: int) -> None:
        """A client has gone."""
        with self._changed:
            self._tasks.pop(client, None)

    def repaint(self, changed: Callable[[Look], bool]) -> None:
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
        """Paint the next picture.

        Returns:
            Whether there was one to paint.
        """
        with self._changed:
            following = self._following()
        if following is None or self._closed:
            return False
        client, task = following
        self._prepare(task.look)
        painted = self._paint(task.look, task.size, lambda: self._wanted(client, task))
        if painted is not None:
            picture, seconds = painted
            self._finish(client, task, seconds)
            self._show(client, task.look, picture, seconds)
        return True

    def _following(self) -> tuple[int, Task[Look]] | None:
        open_ones = [(client, task) for client, task in self._tasks.items() if not task.done]
        return min(open_ones, key=lambda each: each[1].size, default=None)

    def _wanted(self, client: int, task: Task[Look]) -> bool:
        with self._changed:
            return not self._closed and (task.first or self._following() == (client, task))

    def _finish(self, client: int, task: Task[Look], seconds: float) -> None:
        """What follows a picture: a finer one, as fine as the limits allow."""
        with self._changed:
            self._speed = task.size**2 / max(seconds, 1e-6)
            finest, in_time = task.limit.finest, math.isqrt(int(self._speed * task.limit.seconds))
            finer = min(2 * task.size, finest, in_time)
            done = finer <= task.size or finer < min(WORTH * task.size, finest)
            following = replace(task, size=task.size if done else finer, shown=task.size, first=False, done=done)
            if self._tasks.get(client) is task:
                self._tasks[client] = following

    def _expected(self, size: int) -> float:
        """Seconds for a picture. Pictures have other shapes than squares, but the same one before and after."""
        return size**2 / self._speed
