"""Loop of the loss on bends of rendered surfaces, with its gradient: a pass over centres, and one that gathers."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from ctm_plugin.cpu.compiled import compiled, fused_part
from ctm_plugin.cpu.splats import clipped_exp

ZERO, ONE, TWO = (np.float32(value) for value in (0, 1, 2))
STRIDES = (1, 4)
"""Pixels from one of three compared pixels to the next, as in :mod:`ctm_plugin.splats.render`."""
MIN_OPACITY, PER_EDGE = np.float32(0.1), np.float32(-1 / 0.03)
"""Least opacity and inverse edge width of :mod:`ctm_plugin.splats.render`, which this room does not know."""
NEAR, FAR = STRIDES


def bends(inverse: Tensor, stopped: Tensor, colors: Tensor) -> Tensor:
    """Measure how far rendered surfaces are from planes, see :func:`ctm_plugin.splats.render.bends`."""
    return Bends.apply(inverse, stopped, colors)


class Bends(torch.autograd.Function):
    """Autograd function of :func:`bends`, which computes the gradient together with the loss."""

    @staticmethod
    def forward(ctx: Any, inverse: Tensor, stopped: Tensor, colors: Tensor) -> Tensor:
        inverse, stopped = inverse.detach().contiguous(), stopped.detach().contiguous()
        colors = colors.detach().permute(2, 0, 1).contiguous()
        height, width = inverse.shape
        surface, pulls, sums = torch.empty_like(inverse), torch.zeros(4, height, width), torch.zeros(height, 4)
        # Centres along each axis, and what all of them weigh together.
        counts = [max(size - 2 * stride, 0) for size in (height, width) for stride in STRIDES]
        others = [width, width, height, height]
        scales = [
            width / stride / len(STRIDES) / max(count * other, 1)
            for stride, count, other in zip(2 * STRIDES, counts, others, strict=True)
        ]
        scales = torch.tensor(scales)
        grad = torch.empty_like(inverse)
        fold(inverse, stopped, colors, scales, surface, pulls, sums, grad)
        ctx.save_for_backward(grad)
        return (sums.double().sum(0) * scales).sum().float()

    @staticmethod
    def backward(ctx: Any, d_bends: Tensor) -> tuple[Tensor, None, None]:
        (grad,) = ctx.saved_tensors
        return d_bends * grad, None, None


@fused_part
def _folds(before, here, after, first, middle, last, one, other, pull, scale, count):
    """Sum the weighted second differences of inverse depth over a row of centres; ``pull`` gets their slopes.

    ``first``, ``middle`` and ``last`` are the colours ``[k, count]``; ``one`` and ``other`` are room for a row.
    """
    one[:count], other[:count] = ZERO, ZERO
    for c in range(len(middle)):
        for i in range(count):
            one[i] += abs(middle[c, i] - first[c, i])
            other[i] += abs(last[c, i] - middle[c, i])
    per, total = PER_EDGE / np.float32(len(middle)), ZERO
    for i in range(count):
        second = before[i] - TWO * here[i] + after[i]
        weight = clipped_exp(per * max(one[i], other[i]))
        total += abs(second) * weight
        pull[i] = scale * weight * (np.float32(second > ZERO) - np.float32(second < ZERO))
    return total


@compiled("void(f4[:,::1], f4[:,::1], f4[:,:,::1], f4[::1], f4[:,::1], f4[:,:,::1], f4[:,::1], f4[:,::1])", fused=True)
def fold(inverse, stopped, colors, scales, surface, pulls, sums, grad):
    """Divide the depth by what stopped the light, measure its folds, and gather their gradient.

    Args:
        inverse, stopped: ``[H, W]``, of the depth, and the share of the light that made it.
        colors: ``[k, H, W]``.
        scales: ``[4]``, by which folds down at both strides and across at both are weighed.
        surface: ``[H, W]``, left with the inverse depth of what was seen.
        pulls: ``[4, H, W]`` zeros, left with the slopes of the centres' second differences.
        sums: ``[H, 4]`` zeros, left with each row's folds.
        grad: ``[H, W]``, left with the gradient.
    """
    height, width = inverse.shape
    for y in prange(height):
        for x in range(width):
            surface[y, x] = inverse[y, x] / max(stopped[y, x], MIN_OPACITY)
    for y in prange(height):
        one, other = np.empty(width, np.float32), np.empty(width, np.float32)
        for number in range(2):
            k = NEAR if number == 0 else FAR
            if k <= y < height - k:
                sums[y, number] = _folds(
                    surface[y - k], surface[y], surface[y + k], colors[:, y - k], colors[:, y], colors[:, y + k],
                    one, other, pulls[number, y], scales[number], width,
                )  # fmt: skip
            count = width - 2 * k
            if count > 0:
                sums[y, 2 + number] = _folds(
                    surface[y, :count], surface[y, k : k + count], surface[y, 2 * k :],
                    colors[:, y, :count], colors[:, y, k : k + count], colors[:, y, 2 * k :],
                    one, other, pulls[2 + number, y, k : k + count], scales[2 + number], count,
                )  # fmt: skip
    for y in prange(height):
        depth_grad = np.zeros(width, np.float32)
        for number in range(2):
            k = NEAR if number == 0 else FAR
            down, across = pulls[number], pulls[2 + number, y]
            for x in range(width):
                depth_grad[x] -= TWO * (down[y, x] + across[x])
            if y >= k:
                for x in range(width):
                    depth_grad[x] += down[y - k, x]
            if y + k < height:
                for x in range(width):
                    depth_grad[x] += down[y + k, x]
            for x in range(width - k):
                depth_grad[x + k] += across[x]
                depth_grad[x] += across[x + k]
        for x in range(width):
            grad[y, x] = depth_grad[x] / max(stopped[y, x], MIN_OPACITY)
