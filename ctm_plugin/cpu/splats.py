"""Loops that rasterise Gaussians: lists of Gaussians by tile, compositing front to back, and gradients."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from ctm_plugin.cpu.compiled import compiled, fused_part, inlined
from ctm_plugin.cpu.splat_projection import (
    CONIC,
    DEPTH,
    EXTENT,
    GEOMETRY,
    HALF,
    MEAN,
    ONE,
    OPACITY,
    OVER,
    PLANE,
    REACH,
    TWO,
    WIDTH,
    ZERO,
    project,
    project_back,
)

TILE_WIDTH, TILE_HEIGHT = 8, 32
"""Pixels of a tile across and down: a Gaussian's rows in a tile are composited whole."""
TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
"""Number of pixels in a tile."""
MIN_ALPHA, MAX_ALPHA = np.float32(1 / 255), np.float32(0.99)
"""Least alpha that counts, and largest alpha (3DGS)."""
SLACK = np.float32(1e-3)
"""Pixels by which ellipses are enlarged against rounding."""
MIN_TRANSMITTANCE = np.float32(1e-4)
"""A tile is done once the transmittance of all its pixels is below this."""
MIN_EXPONENT = np.float32(-8.0)
"""Exponent below which alpha is less than ``MIN_ALPHA`` at any opacity."""
SIXTEENTH = np.float32(1 / 16)
"""1 / 16 in float32."""
_nodes = 0.25 * np.cos(np.pi * (np.arange(6) + 0.5) / 6) - 0.25
E5, E4, E3, E2, E1, E0 = (np.float32(value) for value in np.polyfit(_nodes, np.exp(_nodes), 5))
"""exp() on [-0.5, 0] to 2e-8: a polynomial makes vectors, the library's function does not."""


def picture(
    gaussians: tuple[Tensor, ...], camera: tuple, shift: Tensor, degrees: int, floor: float, more: int
) -> tuple[Tensor, Tensor]:
    """Render Gaussians without a background, see :func:`ctm_plugin.splats.render.picture`."""
    return Rasterization.apply(*gaussians, shift, camera, degrees, floor, more)


class Rasterization(torch.autograd.Function):
    """Autograd function that renders a picture ``[k + more, H, W]`` and its transmittance ``[H, W]``."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor]:
        *tables, shift, camera, degrees, floor, more = arguments
        tables = [each.detach().contiguous() for each in tables]
        count, k = len(tables[0]), tables[4].shape[1]
        numbers = packed(camera, floor)
        flat = torch.empty(count, GEOMETRY)
        basis = torch.empty(count, degrees**2)
        colors = torch.empty(count, k + more)
        project(*tables, shift.detach().contiguous(), numbers, degrees, flat, basis, colors)
        wide, high = -(-camera.width // TILE_WIDTH), -(-camera.height // TILE_HEIGHT)
        owner, starts, slots, tiles = binned(flat, wide, high)
        image = torch.empty(colors.shape[1], camera.height, camera.width)
        left = torch.empty(camera.height, camera.width)
        ends = torch.empty(wide * high, dtype=torch.int64)
        draw(tiles, owner, flat, colors, wide, image, left, ends)
        ctx.kept = tables, numbers, degrees, flat, basis, colors, (owner, starts, slots, tiles), wide, ends
        ctx.save_for_backward(image, left)
        return image, left

    @staticmethod
    def backward(ctx: Any, d_image: Tensor, d_left: Tensor) -> tuple[Tensor | None, ...]:
        tables, numbers, degrees, flat, basis, colors, (owner, starts, slots, tiles), wide, ends = ctx.kept
        image, left = ctx.saved_tensors
        if colors.shape[1] - tables[4].shape[1] == PLANE:
            raise NotImplementedError("gradients of pictures with depth")
        rows = torch.empty(len(owner), 6 + colors.shape[1])
        draw_back(tiles, owner, flat, colors, wide, image, left, ends, d_image.contiguous(), d_left.contiguous(), rows)
        grads = [torch.empty_like(each) for each in tables]
        d_shift = torch.empty(len(flat), 2)
        project_back(*tables, numbers, degrees, flat, basis, colors, starts, slots, rows, *grads, d_shift)
        return *grads, d_shift, None, None, None, None


def packed(camera: tuple, floor: float) -> Tensor:
    """The camera's numbers in one table ``[27]``, with ``floor``, the least value of a colour."""
    turn, centre, lens, distortion, reach, near, height, width = camera
    middle = torch.tensor([near, floor, width / 2, height / 2])
    return torch.cat([turn.flatten(), centre, lens, distortion, reach, middle]).contiguous()


def binned(flat: Tensor, wide: int, high: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """List the Gaussians that each tile meets, front to back.

    Returns:
        Of S pairs of a Gaussian and a tile: the Gaussian ``[S]``; where each Gaussian's pairs begin ``[N + 1]`` among
        the slots that they lie in ``[S]``; where each tile's list begins ``[tiles + 1]``.
    """
    starts = torch.zeros(len(flat) + 1, dtype=torch.int64)
    tiles = torch.zeros(wide * high + 1, dtype=torch.int64)
    count_pairs(flat, wide, high, starts, tiles)
    pairs = int(starts[-1])
    owner, slots = torch.empty(pairs, dtype=torch.int32), torch.empty(pairs, dtype=torch.int32)
    order = torch.from_numpy(np.argsort(flat[:, DEPTH].numpy(), kind="stable"))
    fill_pairs(flat, order, wide, high, starts, tiles.clone(), owner, slots)
    return owner, starts, slots, tiles


@inlined
def clipped_exp(p):
    """exp(max(p, -8)) for p of at most 0: of p / 16, squared four times."""
    q = max(p, MIN_EXPONENT) * SIXTEENTH
    r = ((((E5 * q + E4) * q + E3) * q + E2) * q + E1) * q + E0
    r = r * r
    r = r * r
    r = r * r
    return r * r


@fused_part
def _pixel(place):
    """Index of the first pixel whose centre does not lie before a position."""
    return math.ceil(place - HALF)


@fused_part
def _span(flat, g, axis, low, high):
    """Between where, along x (axis 0) or y (1), an ellipse lies within a band from low to high of the other axis."""
    other, width = 1 - axis, flat[g, WIDTH + axis]
    center, across, reach = flat[g, MEAN + axis], flat[g, MEAN + other], flat[g, REACH]
    tilt = -flat[g, CONIC + 1] * width
    first, last = max(low - across, -flat[g, EXTENT + other]), min(high - across, flat[g, EXTENT + other])
    if first > last:
        return center, center - TWO
    # The furthest point lies at the ellipse's own extreme, or at the end of the band that is nearest to it.
    peak, over = -flat[g, CONIC + 1] * flat[g, WIDTH + other] * flat[g, EXTENT + axis], flat[g, OVER + other]
    at = min(max(peak, first), last)
    top = center + tilt * at + math.sqrt(max(width * (reach - at * at * over), ZERO))
    at = min(max(-peak, first), last)
    return center + tilt * at - math.sqrt(max(width * (reach - at * at * over), ZERO)), top


@fused_part
def _columns(flat, g, row, wide):
    """First tile of a row of tiles, and the one after the last, whose pixel centres a Gaussian reaches."""
    top = np.float32(row * TILE_HEIGHT)
    least, most = _span(flat, g, 0, top + HALF, top + np.float32(TILE_HEIGHT) - HALF)
    first, last = max(_pixel(least - SLACK), 0), min(_pixel(most + SLACK - ONE) + 1, wide * TILE_WIDTH)
    return (first // TILE_WIDTH, (last - 1) // TILE_WIDTH + 1) if first < last else (0, 0)


@fused_part
def _tile_rows(flat, g, high):
    """First row of tiles, and the one after the last, that a Gaussian reaches."""
    first = min(max(math.floor((flat[g, MEAN + 1] - flat[g, EXTENT + 1]) / np.float32(TILE_HEIGHT)), 0), high)
    last = min(max(math.floor((flat[g, MEAN + 1] + flat[g, EXTENT + 1]) / np.float32(TILE_HEIGHT)) + 1, 0), high)
    return first, last


@compiled("void(f4[:,::1], i8, i8, i8[::1], i8[::1])", parallel=False)
def count_pairs(flat, wide, high, starts, tiles):
    """Count the tiles that each Gaussian meets, and the Gaussians of each tile; then sum both up."""
    for g in range(len(flat)):
        if flat[g, EXTENT] > 0:
            top, bottom = _tile_rows(flat, g, high)
            for row in range(top, bottom):
                first, last = _columns(flat, g, row, wide)
                if last > first:
                    starts[g + 1] += last - first
                    for column in range(first, last):
                        tiles[row * wide + column + 1] += 1
    for g in range(len(flat)):
        starts[g + 1] += starts[g]
    for tile in range(wide * high):
        tiles[tile + 1] += tiles[tile]


@compiled("void(f4[:,::1], i8[::1], i8, i8, i8[::1], i8[::1], i4[::1], i4[::1])", parallel=False)
def fill_pairs(flat, order, wide, high, starts, at, owner, slots):
    """Write the tiles' lists of Gaussians, front to back; ``at`` is the next free slot of each tile's list."""
    for i in range(len(order)):
        g = order[i]
        j = starts[g]
        if starts[g + 1] > j:
            top, bottom = _tile_rows(flat, g, high)
            for row in range(top, bottom):
                first, last = _columns(flat, g, row, wide)
                for column in range(first, last):
                    tile = row * wide + column
                    owner[at[tile]] = g
                    slots[j] = at[tile]
                    at[tile] += 1
                    j += 1


@fused_part
def _rows(flat, g, left, top):
    """First pixel of a tile, and the one after the last, in the rows that a Gaussian reaches there; unsigned."""
    low, high = _span(flat, g, 1, np.float32(left) + HALF, np.float32(left + TILE_WIDTH) - HALF)
    first = min(max(_pixel(low - SLACK) - top, 0), TILE_HEIGHT)
    last = min(max(_pixel(high + SLACK - ONE) + 1 - top, 0), TILE_HEIGHT)
    return np.uint64(first * TILE_WIDTH), np.uint64(max(first, last) * TILE_WIDTH)


@fused_part
def _places(px, py, through, left, top, width, height):
    """Write the centres of a tile's pixels, and their transmittance: 1, or 0 outside the picture."""
    for i in range(TILE_PIXELS):
        x, y = left + i % TILE_WIDTH, top + i // TILE_WIDTH
        px[i], py[i] = np.float32(x) + HALF, np.float32(y) + HALF
        through[i] = ONE if (x < width and y < height) else ZERO


@fused_part
def _lay(px, py, weight, through, first, last, mx, my, a, b, c, o):
    """Composite one Gaussian over a range of pixels. Indices of pixels are unsigned, and products stand in place of
    branches: else LLVM makes no vectors.
    """
    for i in range(first, last):
        dx, dy = px[i] - mx, py[i] - my
        alpha = min(o * clipped_exp(a * dx * dx + b * dx * dy + c * dy * dy), MAX_ALPHA)
        w = alpha * through[i] * np.float32(alpha >= MIN_ALPHA)
        weight[i] = w
        through[i] -= w


@fused_part
def _add(row, weight, first, last, color):
    for i in range(first, last):
        row[i] += weight[i] * color


@compiled(
    "void(i8[::1], i4[::1], f4[:,::1], f4[:,::1], i8, f4[:,:,::1], f4[:,::1], i8[::1])", fused=True,
)  # fmt: skip
def draw(tiles, owner, flat, colors, wide, image, left, ends):
    """Composite each tile's list: picture ``[C, H, W]``, transmittance ``left`` ``[H, W]``; ``ends``: where it ends."""
    channels, height, width = image.shape
    for tile in prange(len(tiles) - 1):
        x0, y0 = (tile % wide) * TILE_WIDTH, (tile // wide) * TILE_HEIGHT
        px, py = np.empty(TILE_PIXELS, np.float32), np.empty(TILE_PIXELS, np.float32)
        weight, through = np.empty(TILE_PIXELS, np.float32), np.empty(TILE_PIXELS, np.float32)
        made = np.zeros((channels, TILE_PIXELS), np.float32)
        _places(px, py, through, x0, y0, width, height)
        end = tiles[tile + 1]
        for s in range(tiles[tile], tiles[tile + 1]):
            g = owner[s]
            first, last = _rows(flat, g, x0, y0)
            mx, my, o = flat[g, MEAN], flat[g, MEAN + 1], flat[g, OPACITY]
            a, b, c = -HALF * flat[g, CONIC], -flat[g, CONIC + 1], -HALF * flat[g, CONIC + 2]
            _lay(px, py, weight, through, first, last, mx, my, a, b, c, o)
            for channel in range(channels):
                _add(made[channel], weight, first, last, colors[g, channel])
            if (s & 15) == 15 and through.max() < MIN_TRANSMITTANCE:
                end = s + 1
                break
        ends[tile] = end
        right, bottom = min(width - x0, TILE_WIDTH), min(height - y0, TILE_HEIGHT)
        for y in range(bottom):
            left[y0 + y, x0 : x0 + right] = through[y * TILE_WIDTH : y * TILE_WIDTH + right]
            for channel in range(channels):
                image[channel, y0 + y, x0 : x0 + right] = made[channel, y * TILE_WIDTH : y * TILE_WIDTH + right]


@fused_part
def _value(value, row, first, last, color):
    for i in range(first, last):
        value[i] = row[i] * color


@fused_part
def _dot(weight, row, first, last):
    total = ZERO
    for i in range(first, last):
        total += weight[i] * row[i]
    return total


@fused_part
def _lift(px, py, weight, value, through, behind, first, last, mx, my, a, b, c, o, sums):
    """Composite a Gaussian again, and sum the gradients of its mean, its conic and its opacity.

    ``value`` v is the loss gradient's product with the Gaussian's colour at a pixel, ``behind`` the same for all light
    behind it: d alpha is ``T v - behind / (1 - alpha)``.
    """
    m0, m1, m2, m11, m12, m22 = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
    for i in range(first, last):
        dx, dy = px[i] - mx, py[i] - my
        raw = o * clipped_exp(a * dx * dx + b * dx * dy + c * dy * dy)
        alpha = min(raw, MAX_ALPHA)
        alpha *= np.float32(alpha >= MIN_ALPHA)
        w = alpha * through[i]
        weight[i] = w
        rest = behind[i] - w * value[i]
        behind[i] = rest
        grad = (through[i] * value[i] - rest / (ONE - alpha)) * alpha * np.float32(raw < MAX_ALPHA)
        through[i] -= w
        gx, gy = grad * dx, grad * dy
        m0 += grad
        m1 += gx
        m2 += gy
        m11 += gx * dx
        m12 += gx * dy
        m22 += gy * dy
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = m0, m1, m2, m11, m12, m22


@compiled(
    "void(i8[::1], i4[::1], f4[:,::1], f4[:,::1], i8, f4[:,:,::1], f4[:,::1], i8[::1], f4[:,:,::1], f4[:,::1],"
    " f4[:,::1])", fused=True,
)  # fmt: skip
def draw_back(tiles, owner, flat, colors, wide, image, left, ends, d_image, d_left, rows):
    """Write gradients for each pair of Gaussian and tile, front to back: mean 2, conic 3, opacity, colours k."""
    channels, height, width = image.shape
    for tile in prange(len(tiles) - 1):
        x0, y0 = (tile % wide) * TILE_WIDTH, (tile // wide) * TILE_HEIGHT
        px, py = np.empty(TILE_PIXELS, np.float32), np.empty(TILE_PIXELS, np.float32)
        weight, value = np.empty(TILE_PIXELS, np.float32), np.empty(TILE_PIXELS, np.float32)
        through, behind = np.empty(TILE_PIXELS, np.float32), np.zeros(TILE_PIXELS, np.float32)
        wanted, sums = np.zeros((channels, TILE_PIXELS), np.float32), np.empty(6, np.float32)
        _places(px, py, through, x0, y0, width, height)
        right, bottom = min(width - x0, TILE_WIDTH), min(height - y0, TILE_HEIGHT)
        for y in range(bottom):
            for x in range(right):
                i = y * TILE_WIDTH + x
                behind[i] = d_left[y0 + y, x0 + x] * left[y0 + y, x0 + x]
                for channel in range(channels):
                    wanted[channel, i] = d_image[channel, y0 + y, x0 + x]
                    behind[i] += wanted[channel, i] * image[channel, y0 + y, x0 + x]
        for s in range(ends[tile], tiles[tile + 1]):
            rows[s, :] = ZERO
        for s in range(tiles[tile], ends[tile]):
            g = owner[s]
            first, last = _rows(flat, g, x0, y0)
            mx, my, o = flat[g, MEAN], flat[g, MEAN + 1], flat[g, OPACITY]
            a, b, c = -HALF * flat[g, CONIC], -flat[g, CONIC + 1], -HALF * flat[g, CONIC + 2]
            _value(value, wanted[0], first, last, colors[g, 0])
            for channel in range(1, channels):
                _add(value, wanted[channel], first, last, colors[g, channel])
            _lift(px, py, weight, value, through, behind, first, last, mx, my, a, b, c, o, sums)
            rows[s, 0] = flat[g, CONIC] * sums[1] + flat[g, CONIC + 1] * sums[2]
            rows[s, 1] = flat[g, CONIC + 1] * sums[1] + flat[g, CONIC + 2] * sums[2]
            rows[s, 2], rows[s, 3], rows[s, 4] = -HALF * sums[3], -sums[4], -HALF * sums[5]
            rows[s, 5] = sums[0] / o
            for channel in range(channels):
                rows[s, 6 + channel] = _dot(weight, wanted[channel], first, last)
