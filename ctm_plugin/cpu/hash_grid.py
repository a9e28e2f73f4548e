"""Loops of lookups in hash grids of two features a vertex, and their gradient: see ``rays/hash_grid.py``."""

from __future__ import annotations

import numpy as np
import torch
from numba import prange
from torch import Tensor

from ctm_plugin.cpu.compiled import compiled, inlined

FEATURES = 2
"""Features a row of the tables."""
PRIME_Y, PRIME_Z = 2654435761, 805459861
"""Primes of the spatial hash, for the second and third coordinate of a vertex."""


def encoded(table: Tensor, points: Tensor, sides: Tensor, starts: Tensor) -> Tensor:
    """Look up hash-grid features (:func:`ctm_plugin.rays.hash_grid.encoded`), level by level for parts of the points: a
    level's table stays in the cache.
    """
    out = table.new_empty(len(points), FEATURES * len(sides))
    _gather(table, points.T.contiguous(), sides, starts, out, torch.get_num_threads())
    return out


def spread(grad: Tensor, points: Tensor, sides: Tensor, starts: Tensor, shape: torch.Size) -> Tensor:
    """Add up features' gradient (:func:`ctm_plugin.rays.hash_grid.spread`) in the points' order, a thread a level."""
    sums = grad.new_zeros(shape)
    _scatter(grad.contiguous(), points.T.contiguous(), sides, starts, sums)
    return sums


@inlined
def _cell(x, side):
    """The vertex before a coordinate, and how far into the cell it lies; a vertex of the grid for NaN too."""
    position = min(max(x, np.float32(0)), np.float32(1)) * np.float32(side)
    below = np.int64(position) if position > 0 else np.int64(0)
    below = min(below, side - 1)
    return below, position - np.float32(below)


@inlined
def layout_of(side, rows):
    """Layout of a level: whether each vertex has its own row, the mask of its rows, and the factors of y and z."""
    dense = (side + 1) ** 3 <= rows
    along_y = side + 1 if dense else np.int64(PRIME_Y)
    along_z = (side + 1) ** 2 if dense else np.int64(PRIME_Z)
    return dense, rows - 1, along_y, along_z


@inlined
def _row(start, x, y, z, dense, mask):
    """Row of a vertex; unsigned, as others are tested for counting from the end, which takes half as long again."""
    return np.uint64(start + (x + y + z if dense else (x ^ y ^ z) & mask))


@inlined
def _placed(points, m, side):
    """A point's cell along each axis, and how far into it the point lies."""
    m = np.uint64(m)
    x, fx = _cell(points[0, m], side)
    y, fy = _cell(points[1, m], side)
    z, fz = _cell(points[2, m], side)
    return x, y, z, fx, fy, fz


@inlined
def _corner(place, start, layout, k, j, i):
    """The row and the weight of one of the eight vertices round a point."""
    one = np.float32(1)
    x, y, z, fx, fy, fz = place
    dense, mask, along_y, along_z = layout
    weight = (fz if k else one - fz) * (fy if j else one - fy) * (fx if i else one - fx)
    return _row(start, x + i, (y + j) * along_y, (z + k) * along_z, dense, mask), weight


@inlined
def looked_up(table, points, m, side, start, layout):
    """Look up both features of point m of ``points`` ``[3, M]`` in a level whose rows begin at ``start``."""
    place = _placed(points, m, side)
    first, second = np.float32(0), np.float32(0)
    for k in range(2):
        for j in range(2):
            for i in range(2):
                row, weight = _corner(place, start, layout, k, j, i)
                first += weight * table[row, 0]
                second += weight * table[row, 1]
    return first, second


@compiled("void(f4[:,::1], f4[:,::1], i8[::1], i8[::1], f4[:,::1], i8)", fused=True)
def _gather(table, points, sides, starts, out, parts):
    levels, count = len(sides), points.shape[1]
    for task in prange(parts * levels):
        part, level = task // levels, task % levels
        side, start = sides[level], starts[level]
        layout = layout_of(side, starts[level + 1] - start)
        for m in range(part * count // parts, (part + 1) * count // parts):
            first, second = looked_up(table, points, m, side, start, layout)
            out[m, 2 * level] = first
            out[m, 2 * level + 1] = second


@compiled("void(f4[:,::1], f4[:,::1], i8[::1], i8[::1], f4[:,::1])", fused=True)
def _scatter(grad, points, sides, starts, sums):
    levels = len(sides)
    for task in prange(levels):
        # Fine levels take longer, and threads get tasks in a row: from both ends in turns.
        level = task // 2 if task % 2 == 0 else levels - 1 - task // 2
        side, start = sides[level], starts[level]
        layout = layout_of(side, starts[level + 1] - start)
        for m in range(points.shape[1]):
            place, first, second = _placed(points, m, side), grad[m, 2 * level], grad[m, 2 * level + 1]
            for k in range(2):
                for j in range(2):
                    for i in range(2):
                        row, weight = _corner(place, start, layout, k, j, i)
                        sums[row, 0] += weight * first
                        sums[row, 1] += weight * second
