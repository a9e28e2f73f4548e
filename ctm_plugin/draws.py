"""Random numbers of a training step, or of another stream, that depend only on seed and step."""

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
        stream: name of the numbers' use. Streams share no numbers; training batches have the one without a name.
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
        """Draw ``[rows, channels]`` float32 from U[0, 1)."""
        drawn = torch.rand(rows * self.world, channels, generator=self.generator, device=self.device)
        return drawn[self.rank * rows : (self.rank + 1) * rows]

    def normal(self, rows: int, channels: int) -> Tensor:
        """Draw ``[rows, channels]`` float32 from N(0, 1)."""
        drawn = torch.randn(rows * self.world, channels, generator=self.generator, device=self.device)
        return drawn[self.rank * rows : (self.rank + 1) * rows]

    def integers(self, high: int, rows: int) -> Tensor:
        """Draw ``[rows]`` int64, uniform in 0..high-1, with replacement."""
        drawn = torch.randint(high, (rows * self.world,), generator=self.generator, device=self.device)
        return drawn[self.rank * rows : (self.rank + 1) * rows]


class FixedDraws(Draws):
    """Draws that are not random: uniform numbers are ``number``, normal ones 0. For rays at fixed places in a pixel."""

    def __init__(self, number: float, device: torch.device | str = "cpu"):
        self.number, self.device = number, torch.device(device)

    def uniform(self, rows: int, channels: int) -> Tensor:
        """Give ``[rows, channels]`` float32, all equal to ``number``."""
        return torch.full((rows, channels), self.number, device=self.device)

    def normal(self, rows: int, channels: int) -> Tensor:
        """Give ``[rows, channels]`` float32 zeros."""
        return torch.zeros(rows, channels, device=self.device)


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Context that seeds torch's generator, for parameters: two models that differ elsewhere start alike."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield
