"""Pictures for all browser clients, from one painter, that get finer while a client's camera rests."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.color.light import AS_IS, Light
from ctm_plugin.view.camera import BrowserCamera

LAYOUTS = ("slider", "side by side")
Rendered = dict[str, Tensor]
MIN_SIDE = 16
"""Longer side in pixels of the coarsest picture; each next one is twice as large, but for the last."""
FIRST_SECONDS = 0.15
"""Seconds that the first picture after a movement should take."""
MIN_GROWTH = 1.25
"""Least ratio of a finer picture's side to the last one's, unless it is the finest."""
ASSUMED_SPEED = 10_000.0
"""Rendering speed in pixels a second, until one is measured."""


class Stopped(Exception):
    """Stops the painting of a picture that its client does not want any more."""


class Viewpoint(NamedTuple):
    """A camera, the background in levels of sRGB, and two corners of a box of the world that the picture is cropped to
    (``None``: no crop)."""

    camera: BrowserCamera
    background: tuple[int, int, int] = (0, 0, 0)
    crop: tuple[tuple[float, ...], tuple[float, ...]] | None = None


class Look(NamedTuple):
    """Request of a client: a run or a photograph, or the left and the right one from one camera.

    Attributes:
        sources: ``render(shot, height, width, check)`` gives whatever ``picture(rendered, kind, light)`` makes a
            picture of, one of :data:`ctm_plugin.runs.load.VIEW_KINDS`; ``check``, called now and then, may raise.
        layout: of two, one of :data:`LAYOUTS`.
        split: how much of the width the left one has under the slider, from 0 to 1.
    """

    shot: Viewpoint
    sources: tuple[Any, ...]
    layout: str = LAYOUTS[0]
    split: float = 0.5
    kind: str = "rgb"
    light: Light = AS_IS

    def alike(self, other: Look) -> bool:
        """Whether two looks need the same renderings."""
        return self[:3] == other[:3]


class Renderings:
    """Cache of the last renderings, which paints looks: a change of only light or kind needs no new rendering."""

    def __init__(self) -> None:
        self._render = lru_cache(4)(self._timed)
        self.clear = self._render.cache_clear

    def paint(self, look: Look, longest: int, check: Callable[[], None]) -> tuple[Float[Tensor, "h w 3"], float]:
        """Paint a look with a longer side of ``longest`` pixels; give the picture, and the seconds its rendering took.

        ``check`` is called now and then; what it raises goes through.
        """
        self._check, shot, aside = check, look.shot, len(look.sources) == 2 and look.layout == "side by side"
        height, width = shot.camera.size(longest)
        if aside:
            width, camera = max(1, width // 2), shot.camera
            shot = shot._replace(camera=replace(camera, aspect=camera.aspect / 2))
        rendered, seconds = zip(*(self._render(source, shot, height, width) for source in look.sources), strict=True)
        pictures = [
            source.picture(each, look.kind, look.light) for source, each in zip(look.sources, rendered, strict=True)
        ]
        if len(pictures) == 1:
            return pictures[0], seconds[0]
        at = width if aside else round(look.split * width)
        picture = torch.cat(pictures if aside else [pictures[0][:, :at], pictures[1][:, at:]], dim=1)
        if 0 < at < picture.shape[1]:
            picture[:, at] = 1  # a white line between
        return picture, sum(seconds)

    def _timed(self, source: Any, shot: Viewpoint, height: int, width: int) -> tuple[Rendered, float]:
        start = time.perf_counter()
        return source.render(shot, height, width, self._check), time.perf_counter() - start


class Limit(NamedTuple):
    """Limits of a client's last picture: its longer side in pixels, and its seconds."""

    finest: int = 1024
    seconds: float = 10.0


@dataclass(eq=False)
class Task:
    """The next picture for a client.

    Attributes:
        size: longer side of the picture in pixels.
        shown: size of the last picture whose renderings suit this look; 0: there is none.
        first: whether it is the first since the client moved. That one is finished even if the client moves on:
            a long movement would show nothing.
        done: whether there is nothing finer to paint.
    """

    look: Any
    limit: Limit
    size: int
    shown: int = 0
    first: bool = True
    done: bool = False


class Painter:
    """Paints what each client looks at, coarse at first, then finer and finer; the coarsest task comes first.

    How coarse and how fine follows from how long the last picture took. A look has a method ``alike``: whether the
    renderings of its last picture do for another look, which is then as fine at once. :meth:`repaint` and :meth:`step`
    belong to one thread; the others return at once and may be called from any.

    Args:
        paint: function of a look and a longer side in pixels that gives the picture and its seconds. It calls its
            third argument now and then, which raises :class:`Stopped` when the picture is not wanted any more.
        show: function that sends a client a picture and its seconds.
    """

    def __init__(
        self,
        paint: Callable[[Any, int, Callable[[], None]], tuple[Any, float]],
        show: Callable[[int, Any, Any, float], None],
    ):
        self._paint, self._show = paint, show
        self._tasks: dict[int, Task] = {}
        self._speed, self._changed, self.closed = ASSUMED_SPEED, threading.Condition(), False

    def ask(self, client: int, look: Any, limit: Limit = Limit()) -> None:  # noqa: B008 (immutable)
        """Set the look that a client wants painted; nothing is painted anew if it is the client's present look."""
        with self._changed:
            before = self._tasks.get(client)
            if before is not None and (before.look, before.limit) == (look, limit):
                return
            size = shown = before.shown if before is not None and before.look.alike(look) else 0
            if not shown:
                size = MIN_SIDE
                while 2 * size <= limit.finest and (2 * size) ** 2 / self._speed <= FIRST_SECONDS:
                    size *= 2
            self._tasks[client] = Task(look, limit, min(size, limit.finest), shown)
            self._changed.notify()

    def forget(self, client: int) -> None:
        """Drop the task of a client that has left."""
        with self._changed:
            self._tasks.pop(client, None)

    def close(self) -> None:
        """Stop the picture that is painted, and paint no more."""
        with self._changed:
            self.closed = True
            self._changed.notify()

    def repaint(self) -> None:
        """Paint every client's picture again at its present size, as after a new checkpoint."""
        for task in self._tasks.copy().values():
            task.first = task.done = False

    def step(self, wait: float = 0.0) -> bool:
        """Paint the next picture, and tell whether there was one within ``wait`` seconds."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self._following() is not None, wait)
            following = self._following()
        if self.closed or following is None:
            return False
        client, task = following

        def check() -> None:
            with self._changed:
                if self.closed or not (task.first or self._following() == following):
                    raise Stopped

        with suppress(Stopped):
            picture, seconds = self._paint(task.look, task.size, check)
            self._finish(task, seconds)
            self._show(client, task.look, picture, seconds)
        return True

    def _following(self) -> tuple[int, Task] | None:
        left = [(client, task) for client, task in self._tasks.items() if not task.done]
        return min(left, key=lambda each: each[1].size, default=None)

    def _finish(self, task: Task, seconds: float) -> None:
        """After a painted picture, set the task's next, finer size, up to the client's limits."""
        with self._changed:
            self._speed = task.size**2 / max(seconds, 1e-6)  # pictures have other shapes, but the same before and after
            finest = task.limit.finest
            finer = min(2 * task.size, finest, math.isqrt(int(self._speed * task.limit.seconds)))
            task.done = finer <= task.size or finer < min(MIN_GROWTH * task.size, finest)
            task.shown, task.first = task.size, False
            task.size = task.size if task.done else finer
