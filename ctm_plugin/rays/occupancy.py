"""The occupancy grid: samples along rays outside free space, and rays that may have such samples.

A vertex of a :class:`~ctm_plugin.rays.grid.VoxelGrid` stands for its cell, half a voxel to all sides; a table ``[V]``
of booleans says which are occupied.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ctm_plugin.door import looped
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.contraction import contract, travelled
from ctm_plugin.rays.grid import VoxelGrid, nearest_rows
from ctm_plugin.rays.sampling import march, pack_samples
from ctm_plugin.rays.volume import segment_sums


@looped("samples:occupied_samples", kernel="samples:occupied_samples")
def occupied_samples(
    origins: Tensor, directions: Tensor, first: Tensor, counts: Tensor, step: float, occupancy: Tensor,
    low: Tensor, scale: Tensor, last: Tensor, offsets: Tensor, contracted: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Keep those samples at ``first + j step``, j < counts, whose nearest vertex is occupied.

    Args:
        origins, directions: ``[R, 3]``.
        first: ``[R]``, where each ray's samples begin.
        counts: ``[R]``, number of samples on each ray.
        occupancy: ``[V]`` boolean.
        low, scale, last, offsets: the lowest corner of the occupancy's grid, and its buffers.
        contracted: samples are at paces, and points in the ball, of :mod:`ctm_plugin.rays.contraction`.

    Returns:
        Distances ``[M]``, rays ``[M]``, points ``[M, 3]``, one coordinate after another in memory.
    """
    t, ray_index = pack_samples(first, counts, step)
    rays = Rays(origins, directions)
    points = contract(rays.points(travelled(t), ray_index)) if contracted else rays.points(t, ray_index)
    keep = occupancy.index_select(0, nearest_rows(points, low, scale, last, offsets)).nonzero().squeeze(1)
    return t.index_select(0, keep), ray_index.index_select(0, keep), points.T.index_select(1, keep).T


def dilate(volume: Float[Tensor, "x y z"]) -> Float[Tensor, "x y z"]:
    """Take the maximum over each vertex and its 26 neighbours."""
    return F.max_pool3d(volume[None], kernel_size=3, stride=1, padding=1)[0]


@torch.no_grad()
def may_meet(
    rays: Rays,
    enter: Float[Tensor, " r"],
    leave: Float[Tensor, " r"],
    grid: VoxelGrid,
    chosen: Bool[Tensor, " v"],
    block: int = 4,
) -> Bool[Tensor, " r"]:
    """Whether a ray may have samples between ``enter`` and ``leave`` whose nearest vertex is a chosen one.

    Marched over blocks of ``block`` voxels a side; errs to True, by up to two blocks.
    """
    volume = chosen.reshape(1, *grid.shape).float()
    # Dilated by one block: a sample stands for all points behind it, up to the next one, less than one block away
    # (along each side, and a hundredth less for rounding). The first sample is where the ray enters.
    blocks = dilate(F.max_pool3d(volume, block, ceil_mode=True)[0])
    fastest = (rays.directions.abs() * grid.scale).max().item()
    t, ray_index = march(enter, leave, 0.99 * block / fastest, 0.0)
    x, y, z = (grid.nearest_index(rays.points(t, ray_index)) // block).unbind(-1)
    return segment_sums(blocks[x, y, z], ray_index, len(rays.origins)) > 0
