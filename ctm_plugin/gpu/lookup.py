"""Kernels of trilinear grid lookups and their gradient: :mod:`ctm_plugin.rays.grid`."""

from __future__ import annotations

import torch
import triton.language as tl
from torch import Tensor
from triton import cdiv, next_power_of_2

from ctm_plugin.gpu.kernels import kernel, launch, whole

POINTS = 128
"""Points that one program of the kernel handles."""
ELEMENT_BLOCK = 512
"""Number of features, over all its points, that one program of a lookup holds at once."""


def corners(points: Tensor, low: Tensor, scale: Tensor, last: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Find rows and weights ``[M, 8]`` of the vertices round points, see :func:`ctm_plugin.rays.grid.corners`."""
    count = len(points)
    rows, weights = points.new_empty(count, 8, dtype=torch.int32), points.new_empty(count, 8)
    box = whole(low, scale, last, offsets)
    launch(_corners, (cdiv(count, POINTS),), points, *points.stride(), *box, rows, weights, count, BLOCK=POINTS)
    return rows, weights


@kernel
def place(x, low, scale, last):
    """Turn a coordinate into a position in voxels, clamped to the grid; NaN stays NaN."""
    at = (x - low) * scale
    return tl.where(at > 0, tl.minimum(at, last), tl.where(at == at, 0.0, at))


@kernel
def cell(at, highest):
    """Find the vertex before a position, for NaN any of the grid, and the share of the way to the next vertex."""
    below = tl.where(at > 0, tl.minimum(tl.floor(at), highest), 0.0)
    return below, at - below


@kernel
def _along(points, m, count, low, scale, last):
    high = tl.load(last)
    return cell(place(tl.load(points + m, mask=m >= 0, other=0.0), tl.load(low), tl.load(scale), high), high - 1)


@kernel
def _corners(points, along, across, low, scale, last, offsets, rows, weights, count, BLOCK: tl.constexpr):
    m, corner = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, 8)
    there = m < count
    at = tl.where(there, m * along, -1)
    x, into_x = _along(points, at, count, low, scale, last)
    y, into_y = _along(points + across, at, count, low + 1, scale + 1, last + 1)
    z, into_z = _along(points + 2 * across, at, count, low + 2, scale + 2, last + 2)
    row = z.to(tl.int32) + y.to(tl.int32) * tl.load(offsets + 2) + x.to(tl.int32) * tl.load(offsets + 4)
    of_x = tl.where((corner // 4 == 1)[None, :], into_x[:, None], 1 - into_x[:, None])
    of_y = tl.where((corner // 2 % 2 == 1)[None, :], into_y[:, None], 1 - into_y[:, None])
    of_z = tl.where((corner % 2 == 1)[None, :], into_z[:, None], 1 - into_z[:, None])
    to = m[:, None] * 8 + corner[None, :]
    tl.store(rows + to, row[:, None] + tl.load(offsets + corner)[None, :], mask=there[:, None])
    tl.store(weights + to, of_y * of_z * of_x, mask=there[:, None])


def weighted(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """Sum a table's rows by weights, ``[M, c]``, see :func:`ctm_plugin.rays.grid.weighted`."""
    values = table.new_empty(len(rows), table.shape[1])
    _go_over(*whole(table.detach(), rows, weights), values, back=False)
    return values


def scattered(rows: Tensor, weights: Tensor, grad: Tensor, shape: torch.Size, sparse: bool) -> Tensor:
    """Add up the gradient of weighted rows, see :func:`ctm_plugin.rays.grid.scattered`, in any order; never sparse."""
    table_grad = grad.new_zeros(shape)
    _go_over(table_grad, *whole(rows, weights, grad), back=True)
    return table_grad


def _go_over(table: Tensor, rows: Tensor, weights: Tensor, numbers: Tensor, back: bool) -> None:
    channels, (count, corners) = table.shape[1], rows.shape
    width = next_power_of_2(channels)
    size = max(1, ELEMENT_BLOCK // width)
    constants = {"BACK": back, "CORNERS": corners, "CHANNELS": channels, "WIDTH": width, "BLOCK": size}
    launch(_look_up, (cdiv(count, size),), table, rows, weights, numbers, count, **constants)


@kernel
def _look_up(
    table, rows, weights, numbers, count,
    BACK: tl.constexpr, CORNERS: tl.constexpr, CHANNELS: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the table's weighted sums ``[M, c]`` at corners; ``BACK``: add the gradient ``numbers`` to the table."""
    m, channel = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, WIDTH)
    there = m < count
    both, at = there[:, None] & (channel < CHANNELS)[None, :], numbers + m[:, None] * CHANNELS + channel[None, :]
    total = tl.load(at, mask=both, other=0.0) if BACK else tl.zeros([BLOCK, WIDTH], tl.float32)
    for corner in tl.static_range(CORNERS):
        row = tl.load(rows + m * CORNERS + corner, mask=there, other=0).to(tl.int64)
        weight = tl.load(weights + m * CORNERS + corner, mask=there, other=0.0)[:, None]
        place = table + row[:, None] * CHANNELS + channel[None, :]
        if BACK:
            tl.atomic_add(place, weight * total, mask=both, sem="relaxed")
        else:
            total += weight * tl.load(place, mask=both, other=0.0)
    if not BACK:
        tl.store(at, total, mask=both)
