"""Loops over samples along rays and their nearest vertices, and over points and the vertices round them.

Of a grid they take its lowest corner ``low``, voxels a unit of length ``scale`` and the index ``last`` of its last
vertex, each ``[3]``, along the sides; vertices are rows of a table, z fastest.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from ctm_plugin.cpu.compiled import compiled, inlined


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
def count_occupied(origins, directions, first, counts, step, occupancy, low, scale, last):
    """How many samples of each ray, at ``first + j step`` for j < counts, have an occupied nearest vertex: ``[R]``."""
    kept = np.zeros(len(counts), np.int64)
    for r in prange(len(counts)):
        found = 0
        for j in range(counts[r]):
            t = first[r] + np.float32(j) * step
            found += _occupied(origins[r], directions[r], t, occupancy, low, scale, last)
        kept[r] = found
    return kept


@compiled(f"void({_RAYS}, i8[::1], f4[::1], i8[::1], f4[:,::1])")
def fill_occupied(origins, directions, first, counts, step, occupancy, low, scale, last, starts, t, ray, points):
    """Write these samples, a ray's from ``starts`` on: distances ``[M]``, rays ``[M]``, points ``[3, M]``."""
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
def fill_corners(points, low, scale, last, rows, weights):
    """Write the rows and trilinear weights ``[M, 8]`` of the vertices round points ``[3, M]``."""
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
