"""Pictures that get finer while nobody moves, for any number of clients, by one painter."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

COARSEST, FINEST = 16, 1024
"""The longer sides of pictures in pixels; each is twice the one before."""
AT_ONCE = 0.15
"""Seconds that the first picture after a movement may be expected to take."""
PATIENCE = 5.0
"""Seconds that the last and finest one may be expected to take."""
GUESS = 10_000.0
"""Pixels a second, as long as none are measured."""

Look, Picture = TypeVar("Look"), TypeVar("Picture")


@dataclass(frozen=True, eq=False)
class Task(Generic[Look]):
    """The next picture for a client.

    Attributes:
        look: what is looked at.
        size: of the picture, its longer side in pixels.
        first: since the client moved. It is finished and shown even if the client has moved on, who would see nothing
            of a long movement otherwise.
        done: there is nothing finer to paint.
    """

    look: Look
    size: int
    first: bool = True
    done: bool = False


class Painter(Generic[Look, Picture]):
    """Paints what each client looks at, coarse at first, then finer and finer; the coarsest task comes first.

    How coarse and how fine follows from how long the last picture took. All methods but :meth:`work` and :meth:`step`
    return at once and may be called from any thread.

    Args:
        prepare: does what a look needs before its picture is begun, whose time it is not; returns whether the picture's
            time tells how long others take.
        paint: makes a picture of a look, its longer side so many pixels. It asks its third argument now and then
            whether to go on, and returns ``None`` when told no.
        show: gives a client a picture and the seconds it took.
        clock: in seconds.
    """

    def __init__(
        self,
        prepare: Callable[[Look], bool],
        paint: Callable[[Look, int, Callable[[], bool]], Picture | None],
        show: Callable[[int, Look, Picture, float], None],
        clock: Callable[[], float] = time.perf_counter,
    ):
        self._prepare, self._paint, self._show, self._clock = prepare, paint, show, clock
        self._tasks: dict[int, Task[Look]] = {}
        self._speed = GUESS
        self._changed = threading.Condition()
        self._closed = False

    def ask(self, client: int, look: Look) -> None:
        """From now on a client looks at this. Nothing is painted anew for who looks at what it looked at before."""
        with self._changed:
            if client in self._tasks and self._tasks[client].look == look:
                return
            size = COARSEST
            while size < FINEST and self._expected(2 * size) <= AT_ONCE:
                size *= 2
            self._tasks[client] = Task(look, size)
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
        """Paint until :meth:`close`; in the thread that calls this alone."""
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
        telling = self._prepare(task.look)
        start = self._clock()
        picture = self._paint(task.look, task.size, lambda: self._wanted(client, task))
        if picture is not None:
            seconds = self._clock() - start
            self._finish(client, task, seconds if telling else None)
            self._show(client, task.look, picture, seconds)
        return True

    def _following(self) -> tuple[int, Task[Look]] | None:
        open_ones = [(client, task) for client, task in self._tasks.items() if not task.done]
        return min(open_ones, key=lambda each: each[1].size, default=None)

    def _wanted(self, client: int, task: Task[Look]) -> bool:
        with self._changed:
            return not self._closed and (task.first or self._following() == (client, task))

    def _finish(self, client: int, task: Task[Look], seconds: float | None) -> None:
        """What follows a picture: a finer one, or the same again where it is not known how long it takes."""
        with self._changed:
            following = replace(task, first=False)
            if seconds is not None:
                self._speed = task.size**2 / max(seconds, 1e-6)
                finer = 2 * task.size
                done = finer > FINEST or self._expected(finer) > PATIENCE
                following = replace(following, size=task.size if done else finer, done=done)
            if self._tasks.get(client) is task:
                self._tasks[client] = following

    def _expected(self, size: int) -> float:
        """Seconds for a picture. Pictures have other shapes than squares, but the same one before and after."""
        return size**2 / self._speed
