"""The random numbers of one training step, or of what else is drawn."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


class Draws:
    """Random numbers that depend only on (seed, step), so that a resumed run draws what an uninterrupted one does.

    With several processes each draws the numbers of all and keeps its own rows: together they train on the batch that
    one process would have drawn.

    Args:
        seed, step: any integers.
        device: where the numbers are wanted.
        rank, world: this process and how many there are.
        stream: what they are for. Streams share no numbers; batches have the one without a name.
    """

    def __init__(
        self, seed: int, step: int, device: torch.device | str = "cpu", rank: int = 0, world: int = 1, stream: str = ""
    ):
        named = f"{seed}/{stream}/{step}" if stream else f"{seed}/{step}"
        digest = hashlib.blake2b(named.encode(), digest_size=8).digest()
        self.generator = torch.Generator(device).manual_seed(int.from_bytes(digest, "little") >> 1)
        self.device = torch.device(device)
        self.rank, self.world = rank, world

    def uniform(self, rows: int, channels: int) -> Tensor:
        """``[rows, channels]`` float32 from U[0, 1)."""
        drawn = torch.rand(rows * self.world, channels, generator=self.generator, device=self.device)
        return drawn[self.rank * rows : (self.rank + 1) * rows]

    def normal(self, rows: int, channels: int) -> Tensor:
        """``[rows, channels]`` float32 from N(0, 1)."""
        drawn = torch.randn(rows * self.world, channels, generator=self.generator, device=self.device)
        return drawn[self.rank * rows : (self.rank + 1) * rows]

    def integers(self, high: int, rows: int) -> Tensor:
        """``[rows]`` int64, uniform in 0..high-1, with replacement."""
        drawn = torch.randint(high, (rows * self.world,), generator=self.generator, device=self.device)
        return drawn[self.rank * rows : (self.rank + 1) * rows]


class FixedDraws(Draws):
    """Draws that are not random: uniform numbers are ``number``, normal ones 0. For rays at fixed places in a pixel."""

    def __init__(self, number: float, device: torch.device | str = "cpu"):
        self.number, self.device = number, torch.device(device)

    def uniform(self, rows: int, channels: int) -> Tensor:
        """``[rows, channels]`` float32, all the same."""
        return torch.full((rows, channels), self.number, device=self.device)

    def normal(self, rows: int, channels: int) -> Tensor:
        """``[rows, channels]`` float32 zeros."""
        return torch.zeros(rows, channels, device=self.device)


class NotedDraws(Draws):
    """Draws of which is noted what was asked for, ``(kind, sizes)``, and what was given."""

    def __init__(self, draws: Draws):
        self.draws, self.device, self.rank, self.world = draws, draws.device, draws.rank, draws.world
        self.asked: list[tuple[str, tuple[int, int]]] = []
        self.given: list[Tensor] = []

    def uniform(self, rows: int, channels: int) -> Tensor:
        return self._note("uniform", rows, channels)

    def normal(self, rows: int, channels: int) -> Tensor:
        return self._note("normal", rows, channels)

    def integers(self, high: int, rows: int) -> Tensor:
        return self._note("integers", high, rows)

    def _note(self, kind: str, *sizes: int) -> Tensor:
        self.asked.append((kind, sizes))
        self.given.append(getattr(self.draws, kind)(*sizes))
        return self.given[-1]


class KnownDraws(Draws):
    """Draws that were made before: ``given`` ``[...]``, in the order in which they are asked for."""

    def __init__(self, draws: Draws, given: list[Tensor]):
        self.device, self.rank, self.world = draws.device, draws.rank, draws.world
        self.left = iter(given)

    def uniform(self, rows: int, channels: int) -> Tensor:
        return next(self.left)

    def normal(self, rows: int, channels: int) -> Tensor:
        return next(self.left)

    def integers(self, high: int, rows: int) -> Tensor:
        return next(self.left)


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Initialise parameters from a seed of their own: two models that differ elsewhere start alike."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield
