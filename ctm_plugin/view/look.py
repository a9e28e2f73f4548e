"""What a client looks at, and the picture of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.view.camera import Camera

LAYOUTS = ("slider", "side by side")
KEPT = 1 << 22
"""Pixels of renderings that are kept, in addition to the last two."""

GoOn = Callable[[], bool]
Rendered = dict[str, Tensor]


class Shot(NamedTuple):
    """What is rendered."""

    camera: Camera
    background: tuple[int, int, int] = (0, 0, 0)
    """sRGB levels 0 to 255."""
    crop: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Two corners of a box of the world, outside which nothing shows; ``None``: all does."""


class Source(Protocol):
    """Where pictures come from: a run, or a photograph."""

    version: object
    """Another one renders another picture of the same shot."""

    def changed(self) -> bool:
        """Whether there is something new."""

    def refresh(self) -> None:
        """Take it."""

    def render(self, shot: Shot, height: int, width: int, go_on: GoOn) -> Rendered | None:
        """Whatever :meth:`picture` needs, ``[H, W, ...]``; ``None`` where ``go_on``, asked now and then, says no."""

    def picture(self, rendered: Rendered, kind: str, factor: float) -> Float[Tensor, "h w 3"]:
        """One of :data:`ctm_plugin.runs.load.KINDS`; ``factor`` brightens what is lit."""


class Look(NamedTuple):
    """What a client looks at: a source, or two from one camera."""

    shot: Shot
    sources: tuple[Source, ...]
    """One, or the left and the right one."""
    layout: str = "slider"
    """Of two, one of :data:`LAYOUTS`."""
    split: float = 0.5
    """How much of the width the left one has under the slider."""
    kind: str = "rgb"
    factor: float = 1.0

    def alike(self, other: Look) -> bool:
        """Whether the renderings of one do for the other."""
        return self[:3] == other[:3]


class Renderings:
    """Pictures of looks, out of the last renderings where they do: another light needs no new one.

    Args:
        clock: in seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter):
        self._clock = clock
        self._kept: dict[tuple, tuple[Rendered, float]] = {}

    def paint(self, look: Look, longest: int, go_on: GoOn) -> tuple[Float[Tensor, "h w 3"], float] | None:
        """A look's picture, its longer side so many pixels, and the seconds that its renderings took, when they did.

        What is new of its sources is taken before. ``None`` where ``go_on``, asked now and then, says no.
        """
        shot, aside = look.shot, len(look.sources) == 2 and look.layout == "side by side"
        height, width = shot.camera.size(longest)
        if aside:
            width, camera = max(1, width // 2), shot.camera
            shot = shot._replace(camera=replace(camera, aspect=camera.aspect / 2))
        pictures, seconds = [], 0.0
        for source in look.sources:
            source.refresh()
            key = (source, source.version, shot, height, width)
            if key not in self._kept:
                start = self._clock()
                if (rendered := source.render(shot, height, width, go_on)) is None:
                    return None
                self._kept[key] = rendered, self._clock() - start
            self._kept[key] = rendered, took = self._kept.pop(key)  # the last one now
            pictures.append(source.picture(rendered, look.kind, look.factor))
            seconds += took
        while len(self._kept) > 2 and sum(height * width for *_, height, width in self._kept) > KEPT:
            del self._kept[next(iter(self._kept))]
        if len(pictures) == 1:
            return pictures[0], seconds
        at = width if aside else round(min(max(look.split, 0), 1) * width)
        picture = torch.cat(pictures if aside else [pictures[0][:, :at], pictures[1][:, at:]], dim=1)
        if 0 < at < picture.shape[1]:
            picture[:, at] = 1  # a white line between
        return picture, seconds
