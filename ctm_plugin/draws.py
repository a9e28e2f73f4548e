"""The random numbers of one training step."""

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
    """

    def __init__(self, seed: int, step: int, device: torch.device | str = "cpu", rank: int = 0, world: int = 1):
        digest = hashlib.blake2b(f"{seed}/{step}".encode(), digest_size=8).digest()
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


class Even(Draws):
    """One number in place of all that are uniform, 0 of all that are normal: for pictures of several rays a pixel."""

    def __init__(self, number: float, device: torch.device | str = "cpu"):
        self.number, self.device = number, torch.device(device)

    def uniform(self, rows: int, channels: int) -> Tensor:
        """``[rows, channels]`` float32, all the same."""
        return torch.full((rows, channels), self.number, device=self.device)

    def normal(self, rows: int, channels: int) -> Tensor:
        """``[rows, channels]`` float32 zeros."""
        return torch.zeros(rows, channels, device=self.device)


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Initialise parameters from a seed of their own: two models that differ elsewhere start alike."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield
