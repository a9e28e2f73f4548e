"""Multiresolution hash grids: features of a point from grids of many resolutions, whose vertices share tables of rows.

Müller et al., Instant Neural Graphics Primitives with a Multiresolution Hash Encoding, SIGGRAPH 2022, section 3. Points
are in the unit cube. A level has N cells a side and N + 1 vertices; where these are no more than its table has rows,
each has one of its own, z slowest, else the row ``(x xor 2654435761 y xor 805459861 z) mod rows`` (eq. 4).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from ctm_plugin.cpu.door import looped
from ctm_plugin.rays.grid import scattered, weighted

PRIMES = (1, 2654435761, 805459861)
"""A large number for each axis."""


def resolutions(levels: int, coarsest: int, finest: int) -> list[int]:
    """Count each level's cells a side: ``floor(N_min b^l)``, ``b = (N_max / N_min)^(1 / (L - 1))`` (eq. 2 and 3)."""
    growth = (finest / coarsest) ** (1 / max(1, levels - 1))
    return [math.floor(coarsest * growth**level + 1e-6) for level in range(levels)]


class HashGrid(nn.Module):
    """The tables of all levels, one after another, and how they are looked up.

    Args:
        levels: L.
        features: numbers a vertex has, F.
        entries: most rows of a level's table, a power of two.
        coarsest, finest: cells a side of the first and the last level.

    Attributes:
        table: ``[V, F]``, near 0 at first (the paper's uniform +-1e-4).
    """

    def __init__(self, levels: int, features: int, entries: int, coarsest: int, finest: int):
        super().__init__()
        sides = resolutions(levels, coarsest, finest)
        rows = [min(entries, (side + 1) ** 3) for side in sides]
        # On the CPU wherever the table is: they are asked for, and a GPU would have to be waited for.
        self.sides, self.starts = torch.tensor(sides), torch.tensor([0, *rows]).cumsum(0)
        self.table = nn.Parameter(torch.empty(sum(rows), features).uniform_(-1e-4, 1e-4))

    def forward(self, points: Float[Tensor, "m 3"], known: Float[Tensor, "m f"] | None = None) -> Float[Tensor, "m f"]:
        """Encode points in [0, 1]^3: L F features each, by level; differentiable in the table only.

        Args:
            points: where.
            known: the features themselves, if they were looked up before.
        """
        return _Encoded.apply(self.table, points, self.sides, self.starts, known)


class _Encoded(torch.autograd.Function):
    @staticmethod
    def forward(ctx, table, points, sides, starts, known):
        ctx.save_for_backward(points, sides, starts)
        ctx.shape = table.shape
        return encoded(table, points, sides, starts) if known is None else known

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        return spread(grad, *ctx.saved_tensors, ctx.shape), None, None, None, None


def hashed_corners(points: Tensor, side: int, rows: int) -> tuple[Int[Tensor, "m 8"], Float[Tensor, "m 8"]]:
    """Find the rows of a level's table, and trilinear weights, of the eight vertices round each point.

    Args:
        points: ``[M, 3]`` in [0, 1]; others are taken to the nearest face.
        side: cells a side.
        rows: of the table.
    """
    position = points.clamp(0, 1) * side
    below = position.floor().clamp_max(side - 1)
    into, below = position - below, below.long()
    # Of the eight numbers from 0 the binary digits, the lowest one first.
    steps = (torch.arange(8, device=points.device)[:, None] >> torch.arange(3, device=points.device)) & 1
    vertices = below[:, None] + steps
    weights = torch.where(steps == 1, into[:, None], 1 - into[:, None]).prod(-1)
    if (side + 1) ** 3 <= rows:
        x, y, z = vertices.unbind(-1)
        return x + (side + 1) * (y + (side + 1) * z), weights
    x, y, z = (vertices[..., axis] * prime for axis, prime in enumerate(PRIMES))
    return (x ^ y ^ z) & (rows - 1), weights


# The paper's two numbers a vertex, which a loop holds in registers.
@looped("hash_grid:encoded", when=lambda table, *_: table.shape[1] == 2)
def encoded(table: Tensor, points: Tensor, sides: Tensor, starts: Tensor) -> Tensor:
    """Look the features of points up: ``[M, L F]``, by level.

    Args:
        table: ``[V, F]`` of all levels.
        points: ``[M, 3]`` in [0, 1].
        sides: ``[L]``, each level's cells a side.
        starts: ``[L + 1]``, where each level's rows begin, and end.
    """
    ends = starts.tolist()
    parts = []
    for side, first, last in zip(sides.tolist(), ends, ends[1:], strict=False):
        parts.append(weighted.reference(table[first:last], *hashed_corners(points, side, last - first)))
    return torch.cat(parts, dim=1)


@looped("hash_grid:spread", when=lambda grad, points, sides, starts, shape: shape[1] == 2)
def spread(grad: Tensor, points: Tensor, sides: Tensor, starts: Tensor, shape: torch.Size) -> Tensor:
    """Add up the gradient ``[V, F]`` of :func:`encoded` in a table of that shape.

    Args:
        grad: ``[M, L F]``.
        points, sides, starts: as there.
        shape: (V, F).
    """
    ends = starts.tolist()
    parts = []
    for side, first, last, each in zip(sides.tolist(), ends, ends[1:], grad.split(shape[1], dim=1), strict=False):
        rows, weights = hashed_corners(points, side, last - first)
        parts.append(scattered.reference(rows, weights, each, torch.Size((last - first, shape[1])), False))
    return torch.cat(parts)
