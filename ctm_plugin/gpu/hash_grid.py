"""Kernels of hash-grid lookups and their gradient, one program for each block of points and level:
:mod:`ctm_plugin.rays.hash_grid`."""

from __future__ import annotations

import torch
import triton.language as tl
from torch import Tensor
from triton import cdiv, next_power_of_2

from ctm_plugin.gpu.kernels import kernel, launch, whole
from ctm_plugin.gpu.lookup import cell, place

POINT_BLOCK = 128
"""Points that one program of the kernel looks up."""
PRIME_Y: tl.constexpr = tl.constexpr(2654435761)
"""Primes of the spatial hash, for the second and third coordinate of a vertex."""
PRIME_Z: tl.constexpr = tl.constexpr(805459861)


def encoded(table: Tensor, points: Tensor, sides: Tensor, starts: Tensor) -> Tensor:
    """Look up hash-grid features of points, see :func:`ctm_plugin.rays.hash_grid.encoded`."""
    features = points.new_empty(len(points), len(sides) * table.shape[1])
    _go_over(table.detach().contiguous(), points, sides, starts, features, back=False)
    return features


def spread(grad: Tensor, points: Tensor, sides: Tensor, starts: Tensor, shape: torch.Size) -> Tensor:
    """Add up the gradient of hash-grid features, see :func:`ctm_plugin.rays.hash_grid.spread`, in any order."""
    table_grad = grad.new_zeros(shape)
    _go_over(table_grad, points, sides, starts, grad.contiguous(), back=True)
    return table_grad


def _go_over(table: Tensor, points: Tensor, sides: Tensor, starts: Tensor, numbers: Tensor, back: bool) -> None:
    (count, _), features, levels = points.shape, table.shape[1], len(sides)
    sizes = {"LEVELS": levels, "FEATURES": features, "WIDTH": next_power_of_2(features), "BLOCK": POINT_BLOCK}
    given = table, points, *points.stride(), *whole(sides, starts), numbers, count
    launch(_look_up, (cdiv(count, POINT_BLOCK), levels), *given, BACK=back, **sizes)


@kernel
def _cell(points, at, there, side):
    below, into = cell(place(tl.load(points + at, mask=there, other=0.0), 0.0, side, side), side - 1)
    return below.to(tl.int64), into


@kernel
def _look_up(
    table, points, along, across, sides, starts, numbers, count,
    BACK: tl.constexpr, LEVELS: tl.constexpr, FEATURES: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the table's features ``[M, L F]`` at points; ``BACK``: add the gradient ``numbers`` to the table."""
    m, feature = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, WIDTH)
    there, level = m < count, tl.program_id(1)
    both = there[:, None] & (feature < FEATURES)[None, :]
    side, start = tl.load(sides + level), tl.load(starts + level)
    rows, length = tl.load(starts + level + 1) - start, side.to(tl.float32)
    x, into_x = _cell(points, m * along, there, length)
    y, into_y = _cell(points + across, m * along, there, length)
    z, into_z = _cell(points + tl.cast(across, tl.int64) * 2, m * along, there, length)
    at = numbers + (m[:, None] * LEVELS + level) * FEATURES + feature[None, :]
    total = tl.load(at, mask=both, other=0.0) if BACK else tl.zeros([BLOCK, WIDTH], tl.float32)
    for corner in tl.static_range(8):  # x fastest
        right, up, back = x + corner % 2, y + corner // 2 % 2, z + corner // 4
        own = right + (up + back * (side + 1)) * (side + 1)
        hashed = (right ^ (up * PRIME_Y) ^ (back * PRIME_Z)) & (rows - 1)
        row = start + tl.where((side + 1) * (side + 1) * (side + 1) <= rows, own, hashed)
        weight = into_x if corner % 2 else 1 - into_x
        weight *= into_y if corner // 2 % 2 else 1 - into_y
        weight *= into_z if corner // 4 else 1 - into_z
        vertex = table + row[:, None] * FEATURES + feature[None, :]
        if BACK:
            tl.atomic_add(vertex, weight[:, None] * total, mask=both, sem="relaxed")
        else:
            total += weight[:, None] * tl.load(vertex, mask=both, other=0.0)
    if not BACK:
        tl.store(at, total, mask=both)
