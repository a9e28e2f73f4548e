"""Kernels that composite projected Gaussians front to back, one program a tile, and their gradients."""

from __future__ import annotations

from typing import Any

import torch
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable
from triton import next_power_of_2

from ctm_plugin.gpu.kernels import kernel, launch, whole

TILE = 16
"""Pixels along a tile's side."""
MIN_TRANSMITTANCE = tl.constexpr(1e-4)
"""A tile is done once all its pixels let less light than this pass; tested after every ``GAUSSIANS_PER_TEST``
Gaussians."""
GAUSSIANS_PER_TEST = tl.constexpr(16)
MIN_ALPHA, MAX_ALPHA = tl.constexpr(1 / 255), tl.constexpr(0.99)
SIDE, PIXELS = tl.constexpr(TILE), tl.constexpr(TILE * TILE)


def rasterize(
    means: Tensor, conics: Tensor, opacities: Tensor, extents: Tensor, depths: Tensor, colors: Tensor, width: int,
    height: int,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Composite Gaussians (:func:`ctm_plugin.splats.render.rasterize`), each tile until its light is below 1e-4."""
    flat = torch.cat([means, conics, opacities[:, None]], 1)
    wide, high = -(-width // TILE), -(-height // TILE)
    owner, starts = tiled(means.detach(), extents.detach(), depths.detach(), wide, high)
    return Composited.apply(flat, colors, owner, starts, (wide, width, height))


def tiled(means: Tensor, extents: Tensor, depths: Tensor, wide: int, high: int) -> tuple[Tensor, Tensor]:
    """List Gaussians by tile, each list front to back.

    Args:
        means, extents: ``[N, 2]`` in pixels.
        depths: ``[N]``.
        wide, high: the picture, in tiles.

    Returns:
        Gaussians ``[S]`` of all lists, and where each tile's begins, ``[tiles + 1]``.
    """
    order = depths.argsort(stable=True)
    means, extents = means[order], extents[order]
    shown = (extents > 0).all(1, keepdim=True)
    limit = means.new_tensor([wide, high])
    first = torch.minimum(((means - extents) / TILE).floor().clamp_min(0), limit).long()
    last = torch.minimum(((means + extents) / TILE).ceil().clamp_min(0), limit).long()
    columns, rows = ((last - first).clamp_min(0) * shown).unbind(1)
    counts = columns * rows
    ends = counts.cumsum(0)
    total = int(ends[-1]) if len(ends) else 0  # a GPU is waited for once
    pair = torch.repeat_interleave(torch.arange(len(order), device=order.device), counts, output_size=total)
    number = torch.arange(total, device=order.device) - (ends - counts)[pair]
    row = number.div(columns[pair], rounding_mode="floor")
    tile = (first[pair, 1] + row) * wide + first[pair, 0] + number - row * columns[pair]
    tile, place = tile.int().sort(stable=True)
    bounds = torch.arange(wide * high + 1, device=tile.device, dtype=tile.dtype)
    return order[pair[place]], torch.searchsorted(tile, bounds)


class Composited(torch.autograd.Function):
    """Composite a picture ``[C, H, W]`` of colours ``[N, C]``, and its transmittance ``[H, W]``.

    Args:
        flat: ``[N, 6]``, each Gaussian's mean (2 numbers), conic (3) and opacity.
        owner, starts: see :func:`tiled`.
        size: number of tiles in a row, and the picture's width and height in pixels.
    """

    @staticmethod
    def forward(ctx: Any, flat: Tensor, colors: Tensor, owner: Tensor, starts: Tensor, size: tuple) -> Any:
        flat, colors = whole(flat, colors)
        channels, (_, width, height) = colors.shape[1], size
        image, left = flat.new_empty(channels, height, width), flat.new_empty(height, width)
        ends = torch.empty_like(starts[1:])
        ctx.constants = {"CHANNELS": channels, "WIDTH": next_power_of_2(channels)}
        launch(draw, (len(ends),), flat, colors, owner, starts, image, left, ends, *size, **ctx.constants)
        ctx.save_for_backward(flat, colors, owner, starts, image, left, ends)
        ctx.size = size
        return image, left

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_image: Tensor, d_left: Tensor) -> Any:
        flat, colors, *kept = ctx.saved_tensors
        d_flat, d_colors = torch.zeros_like(flat), torch.zeros_like(colors)
        given = flat, colors, *kept, *whole(d_image, d_left), d_flat, d_colors, *ctx.size
        # Of one warp: what a program sums up over its pixels is then summed without waiting.
        launch(draw_back, (len(kept[-1]),), *given, **ctx.constants, num_warps=1)
        return d_flat, d_colors, None, None, None


@kernel
def pixels(tile, wide, width, height):
    """Columns, rows and memory offsets of a tile's pixels, and whether each lies in the picture."""
    number = tl.arange(0, PIXELS)
    x = (tile % wide) * SIDE + number % SIDE
    y = (tile // wide) * SIDE + number // SIDE
    return x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5, y * width + x, (x < width) & (y < height)


@kernel
def laid(flat, gaussian, listed, x, y):
    """Alpha of a Gaussian at pixels, not yet cut to ``MAX_ALPHA``, 0 where it is too small; and its factors."""
    row = flat + gaussian * 6
    dx, dy = x - tl.load(row), y - tl.load(row + 1)
    a, b, c = tl.load(row + 2), tl.load(row + 3), tl.load(row + 4)
    opacity = tl.load(row + 5)
    raw = opacity * tl.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    return tl.where(listed & (raw >= MIN_ALPHA), raw, 0.0), dx, dy, a, b, c, opacity


@kernel
def draw(
    flat, colors, owner, starts, image, left, ends, wide, width, height, CHANNELS: tl.constexpr, WIDTH: tl.constexpr
):  # fmt: skip
    """Composite a tile's Gaussians, and write the position in its list where compositing stopped."""
    tile = tl.program_id(0)
    x, y, memory, inside = pixels(tile, wide, width, height)
    channel = tl.arange(0, WIDTH)
    through = tl.where(inside, 1.0, 0.0)
    made = tl.zeros((WIDTH, PIXELS), tl.float32)
    place, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    while place < end:
        for more in range(GAUSSIANS_PER_TEST):
            listed = place + more < end
            gaussian = tl.load(owner + place + more, mask=listed, other=0)
            raw, _, _, _, _, _, _ = laid(flat, gaussian, listed, x, y)
            weight = tl.minimum(raw, MAX_ALPHA) * through
            color = tl.load(colors + gaussian * CHANNELS + channel, mask=channel < CHANNELS, other=0.0)
            made += color[:, None] * weight[None, :]
            through -= weight
        place += GAUSSIANS_PER_TEST
        end = tl.where(tl.max(through, 0) < MIN_TRANSMITTANCE, tl.minimum(place, end), end)
    tl.store(ends + tile, end)
    tl.store(left + memory, through, mask=inside)
    shown = (channel < CHANNELS)[:, None] & inside[None, :]
    tl.store(image + channel[:, None] * (width * height) + memory[None, :], made, mask=shown)


@kernel
def draw_back(
    flat, colors, owner, starts, image, left, ends, d_image, d_left, d_flat, d_colors, wide, width, height,
    CHANNELS: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """Composite a tile's Gaussians once more, front to back, and add up the gradients of each.

    ``value`` is the loss gradient's product with a Gaussian's colour at a pixel, ``behind`` the same for all light
    behind it. So d alpha is ``T value - behind / (1 - alpha)``.
    """
    tile = tl.program_id(0)
    x, y, memory, inside = pixels(tile, wide, width, height)
    channel = tl.arange(0, WIDTH)
    through = tl.where(inside, 1.0, 0.0)
    shown = (channel < CHANNELS)[:, None] & inside[None, :]
    places = channel[:, None] * (width * height) + memory[None, :]
    wanted = tl.load(d_image + places, mask=shown, other=0.0)
    behind = tl.sum(wanted * tl.load(image + places, mask=shown, other=0.0), 0)
    behind += tl.load(d_left + memory, mask=inside, other=0.0) * tl.load(left + memory, mask=inside, other=0.0)
    for place in range(tl.load(starts + tile), tl.load(ends + tile)):
        gaussian = tl.load(owner + place)
        raw, dx, dy, a, b, c, opacity = laid(flat, gaussian, True, x, y)
        alpha = tl.minimum(raw, MAX_ALPHA)
        weight = alpha * through
        if tl.sum(weight, 0) > 0:
            color = tl.load(colors + gaussian * CHANNELS + channel, mask=channel < CHANNELS, other=0.0)
            value = tl.sum(wanted * color[:, None], 0)
            behind -= weight * value
            grad = tl.where(raw < MAX_ALPHA, (through * value - behind / (1 - alpha)) * alpha, 0.0)
            through -= weight
            d_color = tl.sum(wanted * weight[None, :], 1)
            tl.atomic_add(d_colors + gaussian * CHANNELS + channel, d_color, mask=channel < CHANNELS)
            across, down = tl.sum(grad * dx, 0), tl.sum(grad * dy, 0)
            row = d_flat + gaussian * 6
            tl.atomic_add(row, a * across + b * down)
            tl.atomic_add(row + 1, b * across + c * down)
            tl.atomic_add(row + 2, -0.5 * tl.sum(grad * dx * dx, 0))
            tl.atomic_add(row + 3, -tl.sum(grad * dx * dy, 0))
            tl.atomic_add(row + 4, -0.5 * tl.sum(grad * dy * dy, 0))
            tl.atomic_add(row + 5, tl.sum(grad, 0) / opacity)
