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

from ctm_plugin.door import looped

PRIMES = (1, 2654435761, 805459861)
"""Primes of the spatial hash, one for each axis (Teschner et al. 2003)."""
POINT_BLOCK = 1 << 16
"""Points that plain torch looks up at once: their corners take about half a gigabyte with 16 levels."""


def resolutions(levels: int, coarsest: int, finest: int) -> list[int]:
    """Count each level's cells a side: ``floor(N_min b^l)``, ``b = (N_max / N_min)^(1 / (L - 1))`` (eq. 2 and 3)."""
    growth = (finest / coarsest) ** (1 / max(1, levels - 1))
    return [math.floor(coarsest * growth**level + 1e-6) for level in range(levels)]


class HashGrid(nn.Module):
    """Multiresolution hash grid: the feature tables of all levels, one after another, and their lookup.

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
        self.register_buffer("sides", torch.tensor(sides), persistent=False)
        self.register_buffer("starts", torch.tensor([0, *rows]).cumsum(0), persistent=False)
        self.table = nn.Parameter(torch.empty(sum(rows), features).uniform_(-1e-4, 1e-4))

    def forward(self, points: Float[Tensor, "m 3"], known: Float[Tensor, "m f"] | None = None) -> Float[Tensor, "m f"]:
        """Encode points in [0, 1]^3: L F features each, by level; differentiable in the table only.

        Args:
            points: positions in the unit cube.
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


def hashed_corners(
    points: Float[Tensor, "m 3"], sides: Int[Tensor, " l"], starts: Int[Tensor, " l+1"]
) -> tuple[Int[Tensor, "m l 8"], Float[Tensor, "m l 8"]]:
    """Find the rows of the table, and trilinear weights, of the eight vertices round each point, x fastest, by level.

    All levels at once: on a GPU each by itself would take as long.

    Args:
        points: in [0, 1]; others are taken to the nearest face.
        sides, starts: see :func:`encoded`.
    """
    position = points.clamp(0, 1)[:, None] * sides[:, None]
    below = torch.minimum(position.floor(), sides[:, None] - 1)
    into, below = position - below, below.long()
    ends, shares = torch.stack([below, below + 1], dim=-1), torch.stack([1 - into, into], dim=-1)  # [M, L, 3, 2]

    def along(axis: int, ends: Tensor) -> Tensor:
        """View an axis's two ends as ``[M, L, z, y, x]``: that axis has length 2, the others 1."""
        return ends[:, :, axis].unflatten(2, [2 if each == axis else 1 for each in (2, 1, 0)])

    rows, across = starts.diff(), sides + 1
    own = along(0, ends) + (along(1, ends) + along(2, ends) * across[:, None, None, None]) * across[:, None, None, None]
    hashed = along(0, ends) ^ along(1, ends * PRIMES[1]) ^ along(2, ends * PRIMES[2])
    rows_at = torch.where((across**3 <= rows)[:, None], own.flatten(2), hashed.flatten(2) & (rows[:, None] - 1))
    weights = along(0, shares) * along(1, shares) * along(2, shares)
    return rows_at + starts[:-1, None], weights.flatten(2)


# The paper's two numbers a vertex, which a loop holds in registers.
@looped("hash_grid:encoded", when=lambda table, *_: table.shape[1] == 2, kernel="hash_grid:encoded")
def encoded(table: Tensor, points: Tensor, sides: Tensor, starts: Tensor) -> Tensor:
    """Look the features of points up: ``[M, L F]``, by level.

    Args:
        table: ``[V, F]`` of all levels.
        points: ``[M, 3]`` in [0, 1].
        sides: ``[L]``, each level's cells a side.
        starts: ``[L + 1]``, where each level's rows begin, and end.
    """
    parts = []
    for block in points.split(POINT_BLOCK):
        rows, weights = hashed_corners(block, sides, starts)
        values = table.index_select(0, rows.flatten()).view(*rows.shape, table.shape[1])
        parts.append((values * weights[..., None]).sum(2).flatten(1))
    return torch.cat(parts)


@looped(
    "hash_grid:spread",
    when=lambda grad, points, sides, starts, shape: shape[1] == 2,
    kernel="hash_grid:spread",
)
def spread(grad: Tensor, points: Tensor, sides: Tensor, starts: Tensor, shape: torch.Size) -> Tensor:
    """Add up the gradient ``[V, F]`` of :func:`encoded` in a table of that shape.

    Args:
        grad: ``[M, L F]``.
        points, sides, starts: see :func:`encoded`.
        shape: (V, F).
    """
    table_grad = grad.new_zeros(shape)
    for block, each in zip(points.split(POINT_BLOCK), grad.split(POINT_BLOCK), strict=True):
        rows, weights = hashed_corners(block, sides, starts)
        parts = each.view(*rows.shape[:2], 1, shape[1]) * weights[..., None]
        table_grad.index_add_(0, rows.flatten(), parts.flatten(0, 2))
    return table_grad
