"""Packed samples along rays outside free space, and the voxels round them, without tables for what is dropped."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numba import prange
from torch import Tensor

from ctm_plugin.kernels.compiled import compiled, inlined

if TYPE_CHECKING:
    from ctm_plugin.rays.grid import Lattice


def occupied_samples(
    origins: Tensor, directions: Tensor, first: Tensor, counts: Tensor, step: float, occupancy: Tensor, lattice: Lattice
) -> tuple[Tensor, Tensor, Tensor]:
    """Of the samples at ``first + j step``, j < counts, those whose nearest vertex is occupied.

    Args:
        origins, directions: ``[R, 3]``.
        first: ``[R]``, where each ray's samples begin.
        counts: ``[R]``, how many they are.
        occupancy: ``[V]`` boolean.
        lattice: the occupancy's vertices.

    Returns:
        Distances ``[M]``, rays ``[M]``, points ``[M, 3]``, one coordinate after another in memory.

    Raises:
        ValueError: a count is negative, as of rays that are no numbers.
    """
    if len(counts) and counts.min() < 0:
        raise ValueError(f"{int(counts.min())} samples on a ray: is it a number?")
    grid = lattice.box[0], lattice.scale, lattice.last
    rays = *(each.contiguous() for each in (origins, directions, first, counts)), np.float32(step)
    kept = torch.from_numpy(_count(*rays, occupancy, *grid))
    starts = kept.cumsum(0) - kept
    total = int(kept.sum())
    t, ray, points = first.new_empty(total), counts.new_empty(total), first.new_empty(3, total)
    _fill(*rays, occupancy, *grid, starts, t, ray, points)
    return t, ray, points.T


def corners(points: Tensor, lattice: Lattice) -> tuple[Tensor, Tensor]:
    """Rows and weights ``[M, 8]`` of the vertices round points ``[M, 3]``."""
    rows, weights = points.new_empty(len(points), 8, dtype=torch.int32), points.new_empty(len(points), 8)
    _corners(points.T.contiguous(), lattice.box[0], lattice.scale, lattice.last, rows, weights)
    return rows, weights


@inlined
def _position(x, axis, low, scale, last):
    return min(max((x - low[axis]) * scale[axis], np.float32(0)), last[axis])


@inlined
def _below(position, highest):
    """The vertex before a position; a vertex of the grid for NaN too, as loops do not look again."""
    return min(np.floor(position), highest) if position > 0 else np.float32(0)


@inlined
def _occupied(origin, direction, t, occupancy, low, scale, last):
    row = np.int64(0)
    for axis in range(3):
        at = _position(origin[axis] + direction[axis] * t, axis, low, scale, last)
        row = row * (np.int64(last[axis]) + 1) + (np.int64(np.rint(at)) if at > 0 else np.int64(0))
    return occupancy[row]


_RAYS = "f4[:,::1], f4[:,::1], f4[::1], i8[::1], f4, b1[::1], f4[::1], f4[::1], f4[::1]"


@compiled(f"i8[::1]({_RAYS})")
def _count(origins, directions, first, counts, step, occupancy, low, scale, last):
    kept = np.zeros(len(counts), np.int64)
    for r in prange(len(counts)):
        found = 0
        for j in range(counts[r]):
            t = first[r] + np.float32(j) * step
            found += _occupied(origins[r], directions[r], t, occupancy, low, scale, last)
        kept[r] = found
    return kept


@compiled(f"void({_RAYS}, i8[::1], f4[::1], i8[::1], f4[:,::1])")
def _fill(origins, directions, first, counts, step, occupancy, low, scale, last, starts, t, ray, points):
    for r in prange(len(counts)):
        m = starts[r]
        for j in range(counts[r]):
            at = first[r] + np.float32(j) * step
            if _occupied(origins[r], directions[r], at, occupancy, low, scale, last):
                t[m] = at
                ray[m] = r
                for axis in range(3):
                    points[axis, m] = origins[r, axis] + directions[r, axis] * at
                m += 1


@compiled("void(f4[:,::1], f4[::1], f4[::1], f4[::1], i4[:,::1], f4[:,::1])")
def _corners(points, low, scale, last, rows, weights):
    one = np.float32(1)
    ny, nz = np.int32(last[1]) + np.int32(1), np.int32(last[2]) + np.int32(1)
    for m in prange(points.shape[1]):
        px = _position(points[0, m], 0, low, scale, last)
        py = _position(points[1, m], 1, low, scale, last)
        pz = _position(points[2, m], 2, low, scale, last)
        ix, iy, iz = _below(px, last[0] - one), _below(py, last[1] - one), _below(pz, last[2] - one)
        x, y, z = px - ix, py - iy, pz - iz
        row = (np.int32(ix) * ny + np.int32(iy)) * nz + np.int32(iz)
        for i in range(2):
            wx = x if i else one - x
            for j in range(2):
                wy = y if j else one - y
                for k in range(2):
                    wz = z if k else one - z
                    corner = 4 * i + 2 * j + k
                    rows[m, corner] = row + (i * ny + j) * nz + k
                    weights[m, corner] = (wy * wz) * wx
