"""Loops over samples along rays and their nearest vertices, and over points and the vertices round them.

Of a grid they take its lowest corner ``low``, voxels a unit of length ``scale`` and the index ``last`` of its last
vertex, each ``[3]``, along the sides; vertices are rows of a table, z fastest. ``offsets`` ``[8]`` are the rows between
a vertex and its next ones: (0, 0, 0), (0, 0, 1) ... (1, 1, 1).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import prange
from torch import Tensor

from ctm_plugin.cpu.compiled import compiled, each_once, inlined


def occupied_samples(
    origins: Tensor, directions: Tensor, first: Tensor, counts: Tensor, step: float, occupancy: Tensor,
    low: Tensor, scale: Tensor, last: Tensor, offsets: Tensor, contracted: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Do as :func:`ctm_plugin.rays.grid.occupied_samples`; no table is made of the samples that are dropped.

    Raises:
        ValueError: a count is negative, as of rays that are no numbers.
    """
    if len(counts) and counts.min() < 0:
        raise ValueError(f"{int(counts.min())} samples on a ray: is it a number?")
    given = *(each.contiguous() for each in (origins, directions, first, counts)), np.float32(step)
    given += occupancy, low, scale, last, contracted
    kept = torch.from_numpy(count_occupied(*given))
    starts, total = kept.cumsum(0) - kept, int(kept.sum())
    t, ray, points = first.new_empty(total), counts.new_empty(total), first.new_empty(3, total)
    fill_occupied(*given, starts, t, ray, points)
    return t, ray, points.T


def corners(points: Tensor, low: Tensor, scale: Tensor, last: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Do as :func:`ctm_plugin.rays.grid.corners`."""
    rows, weights = points.new_empty(len(points), 8, dtype=torch.int32), points.new_empty(len(points), 8)
    fill_corners(points.T.contiguous(), low, scale, last, offsets, rows, weights)
    return rows, weights


def _near_samples(*arguments) -> tuple[int, int]:
    """Of the occupancy what samples are near."""
    counts, occupancy = arguments[3], arguments[5]
    return each_once(*arguments)[0] - occupancy.nbytes + min(occupancy.nbytes, int(counts.sum())), 0


@inlined
def _position(x, axis, low, scale, last):
    return min(max((x - low[axis]) * scale[axis], np.float32(0)), last[axis])


@inlined
def _below(position, highest):
    """The vertex before a position; a vertex of the grid for NaN too, as loops do not look again."""
    return min(np.floor(position), highest) if position > 0 else np.float32(0)


@inlined
def _travelled(pace):
    """As ``rays/contraction.travelled``."""
    return pace if pace <= np.float32(2) else np.float32(4) / (np.float32(4) - pace)


@inlined
def _drawn_in(x, y, z, contracted):
    """What a point is multiplied by to be ``rays/contraction.contract`` of it."""
    norm = math.sqrt(x * x + y * y + z * z) if contracted else np.float32(0)
    return (np.float32(2) - np.float32(1) / norm) / norm if norm > np.float32(1) else np.float32(1)


@inlined
def _point(origin, direction, t, contracted):
    far = _travelled(t) if contracted else t
    x, y, z = (origin[0] + direction[0] * far, origin[1] + direction[1] * far, origin[2] + direction[2] * far)
    factor = _drawn_in(x, y, z, contracted)
    return x * factor, y * factor, z * factor


@inlined
def _occupied(x, y, z, occupancy, low, scale, last):
    row = np.int64(0)
    for axis, of_axis in enumerate((x, y, z)):
        at = _position(of_axis, axis, low, scale, last)
        row = row * (np.int64(last[axis]) + 1) + (np.int64(np.rint(at)) if at > 0 else np.int64(0))
    return occupancy[row]


_RAYS = "f4[:,::1], f4[:,::1], f4[::1], i8[::1], f4, b1[::1], f4[::1], f4[::1], f4[::1], b1"


@compiled(f"i8[::1]({_RAYS})", cost=_near_samples)
def count_occupied(origins, directions, first, counts, step, occupancy, low, scale, last, contracted):
    """Count each ray's samples, at ``first + j step`` for j < counts, whose nearest vertex is occupied: ``[R]``."""
    kept = np.zeros(len(counts), np.int64)
    for r in prange(len(counts)):
        found = 0
        for j in range(counts[r]):
            x, y, z = _point(origins[r], directions[r], first[r] + np.float32(j) * step, contracted)
            found += _occupied(x, y, z, occupancy, low, scale, last)
        kept[r] = found
    return kept


@compiled(f"void({_RAYS}, i8[::1], f4[::1], i8[::1], f4[:,::1])", cost=_near_samples)
def fill_occupied(
    origins, directions, first, counts, step, occupancy, low, scale, last, contracted, starts, t, ray, points
):
    """Write these samples, a ray's from ``starts`` on: distances ``[M]``, rays ``[M]``, points ``[3, M]``."""
    for r in prange(len(counts)):
        m = starts[r]
        for j in range(counts[r]):
            at = first[r] + np.float32(j) * step
            x, y, z = _point(origins[r], directions[r], at, contracted)
            if _occupied(x, y, z, occupancy, low, scale, last):
                t[m] = at
                ray[m] = r
                points[0, m], points[1, m], points[2, m] = x, y, z
                m += 1


@compiled("void(f4[:,::1], f4[::1], f4[::1], f4[::1], i4[::1], i4[:,::1], f4[:,::1])")
def fill_corners(points, low, scale, last, offsets, rows, weights):
    """Write the rows and trilinear weights ``[M, 8]`` of the vertices round points ``[3, M]``."""
    one = np.float32(1)
    for m in prange(points.shape[1]):
        px = _position(points[0, m], 0, low, scale, last)
        py = _position(points[1, m], 1, low, scale, last)
        pz = _position(points[2, m], 2, low, scale, last)
        ix, iy, iz = _below(px, last[0] - one), _below(py, last[1] - one), _below(pz, last[2] - one)
        x, y, z = px - ix, py - iy, pz - iz
        row = np.int32(ix) * offsets[4] + np.int32(iy) * offsets[2] + np.int32(iz)
        for i in range(2):
            wx = x if i else one - x
            for j in range(2):
                wy = y if j else one - y
                for k in range(2):
                    wz = z if k else one - z
                    corner = 4 * i + 2 * j + k
                    rows[m, corner] = row + offsets[corner]
                    weights[m, corner] = (wy * wz) * wx
