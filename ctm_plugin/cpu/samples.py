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

from ctm_plugin.cpu.compiled import compiled, inlined

BLOCK_SIDE = 4
"""Vertices along a block's side; blocks without an occupied vertex are skipped."""
MAX_VERTEX_RATIO = 8
"""Largest ratio of vertices to samples for which blocks are marked: it takes 0.6 ms for a million vertices."""
MAX_SKIPPED = 1 << 20
"""Most samples that are skipped at once."""


def occupied_samples(
    origins: Tensor, directions: Tensor, first: Tensor, counts: Tensor, step: float, occupancy: Tensor,
    low: Tensor, scale: Tensor, last: Tensor, offsets: Tensor, contracted: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Find samples in occupied cells (:func:`ctm_plugin.rays.occupancy.occupied_samples`), without storing others.

    Raises:
        ValueError: a count is negative, as for rays with NaN.
    """
    if len(counts) and counts.min() < 0:
        raise ValueError(f"{int(counts.min())} samples on a ray: is it a number?")
    rays = *(each.contiguous() for each in (origins, directions, first, counts)), np.float32(step)
    begin = counts.cumsum(0) - counts
    hits = counts.new_empty(int(counts.sum()), dtype=torch.int32)
    skip = not contracted and MAX_VERTEX_RATIO * len(hits) >= len(occupancy)
    blocks = torch.from_numpy(occupied_blocks(occupancy, last.long() + 1)) if skip else occupancy.new_empty(1, 1, 1)
    kept = torch.from_numpy(find_occupied(*rays, occupancy, blocks, low, scale, last, contracted, skip, begin, hits))
    starts, total = kept.cumsum(0) - kept, int(kept.sum())
    t, ray, points = first.new_empty(total), counts.new_empty(total), first.new_empty(3, total)
    fill_occupied(*rays, contracted, begin, hits, starts, kept, t, ray, points)
    return t, ray, points.T


def corners(points: Tensor, low: Tensor, scale: Tensor, last: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Find rows and weights ``[M, 8]`` of the vertices round points, see :func:`ctm_plugin.rays.grid.corners`."""
    rows, weights = points.new_empty(len(points), 8, dtype=torch.int32), points.new_empty(len(points), 8)
    fill_corners(points.T.contiguous(), low, scale, last, offsets, rows, weights)
    return rows, weights


@inlined
def _position(x, axis, low, scale, last):
    return min(max((x - low[axis]) * scale[axis], np.float32(0)), last[axis])


@inlined
def _nearest(position):
    """Nearest vertex to a position; for NaN any of the grid, as loops do not check bounds."""
    return np.int64(np.rint(position)) if position > 0 else np.int64(0)


@inlined
def _below(position, highest):
    """Vertex before a position; for NaN any of the grid."""
    return min(np.floor(position), highest) if position > 0 else np.float32(0)


@inlined
def _travelled(pace):
    """Distance along a ray at a pace, as ``rays/contraction.travelled``."""
    return pace if pace <= np.float32(2) else np.float32(4) / (np.float32(4) - pace)


@inlined
def _drawn_in(x, y, z, contracted):
    """Factor on a point that contracts it, as ``rays/contraction.contract``."""
    norm = math.sqrt(x * x + y * y + z * z) if contracted else np.float32(0)
    return (np.float32(2) - np.float32(1) / norm) / norm if norm > np.float32(1) else np.float32(1)


@inlined
def _point(origin, direction, t, contracted):
    far = _travelled(t) if contracted else t
    x, y, z = (origin[0] + direction[0] * far, origin[1] + direction[1] * far, origin[2] + direction[2] * far)
    factor = _drawn_in(x, y, z, contracted)
    return x * factor, y * factor, z * factor


@compiled("b1[:,:,::1](b1[::1], i8[::1])")
def occupied_blocks(occupancy, shape):
    """Mark the blocks of ``BLOCK_SIDE`` vertices a side that have an occupied one: ``[ceil(X / BLOCK_SIDE), ...]``."""
    of_x, of_y, of_z = (
        (shape[0] - 1) // BLOCK_SIDE + 1,
        (shape[1] - 1) // BLOCK_SIDE + 1,
        (shape[2] - 1) // BLOCK_SIDE + 1,
    )
    blocks = np.zeros((of_x, of_y, of_z), np.bool_)
    for block in prange(of_x):
        for x in range(block * BLOCK_SIDE, min((block + 1) * BLOCK_SIDE, shape[0])):
            for y in range(shape[1]):
                row = (x * shape[1] + y) * shape[2]
                for z in range(shape[2]):
                    blocks[block, y // BLOCK_SIDE, z // BLOCK_SIDE] |= occupancy[row + z]
    return blocks


@inlined
def _left(position, vertex, pace):
    """Number of samples, not rounded, until a ray leaves a block along one axis; ``MAX_SKIPPED`` where ``pace`` is 0.

    ``position`` is in vertices, ``vertex`` the nearest one, ``pace`` in vertices a sample.
    """
    begin = np.float32(vertex // BLOCK_SIDE * BLOCK_SIDE) - np.float32(0.5)
    end = begin + np.float32(BLOCK_SIDE)
    if pace == 0:
        return np.float32(MAX_SKIPPED)
    return ((end if pace > 0 else begin) - position) / pace


_RAYS = "f4[:,::1], f4[:,::1], f4[::1], i8[::1], f4"


@compiled(f"i8[::1]({_RAYS}, b1[::1], b1[:,:,::1], f4[::1], f4[::1], f4[::1], b1, b1, i8[::1], i4[::1])")
def find_occupied(
    origins, directions, first, counts, step, occupancy, blocks, low, scale, last, contracted, skip, begin, hits
):
    """Write which of each ray's samples, at ``first + j step`` for j < counts, have an occupied nearest vertex, from
    ``begin`` on in ``hits``, and count them: ``[R]``. ``skip`` passes blocks without any in one go; rays are straight.
    """
    kept = np.zeros(len(counts), np.int64)
    of_y, of_z = np.int64(last[1]) + 1, np.int64(last[2]) + 1
    for r in prange(len(counts)):
        m, j = begin[r], 0
        while j < counts[r]:
            x, y, z = _point(origins[r], directions[r], first[r] + np.float32(j) * step, contracted)
            px, py, pz = (
                _position(x, 0, low, scale, last),
                _position(y, 1, low, scale, last),
                _position(z, 2, low, scale, last),
            )
            vx, vy, vz = _nearest(px), _nearest(py), _nearest(pz)
            if not skip or blocks[vx // BLOCK_SIDE, vy // BLOCK_SIDE, vz // BLOCK_SIDE]:
                hits[m] = j
                m += occupancy[(vx * of_y + vy) * of_z + vz]
                j += 1
            else:
                left = min(
                    _left(px, vx, directions[r, 0] * scale[0] * step),
                    _left(py, vy, directions[r, 1] * scale[1] * step),
                    _left(pz, vz, directions[r, 2] * scale[2] * step),
                )
                # A hundredth of a sample is more than all rounding; for NaN too the next one.
                left -= np.float32(0.01)
                j += 1 + (np.int64(min(left, np.float32(MAX_SKIPPED))) if left > 0 else 0)
        kept[r] = m - begin[r]
    return kept


@compiled(f"void({_RAYS}, b1, i8[::1], i4[::1], i8[::1], i8[::1], f4[::1], i8[::1], f4[:,::1])")
def fill_occupied(origins, directions, first, counts, step, contracted, begin, hits, starts, kept, t, ray, points):
    """Write the occupied samples, each ray's from ``starts`` on: distances ``[M]``, rays ``[M]``, points ``[3, M]``."""
    for r in prange(len(counts)):
        for k in range(kept[r]):
            m, at = starts[r] + k, first[r] + np.float32(hits[begin[r] + k]) * step
            t[m], ray[m] = at, r
            points[0, m], points[1, m], points[2, m] = _point(origins[r], directions[r], at, contracted)


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
