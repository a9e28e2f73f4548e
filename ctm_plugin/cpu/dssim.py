"""Structural dissimilarity with its gradient, in four passes over rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from ctm_plugin.cpu.compiled import compiled

WINDOW = 11
C1, C2, ONE, TWO = (np.float32(value) for value in (0.01**2, 0.03**2, 1, 2))


def dssim(image: Tensor, target: Tensor) -> Tensor:
    """Do as :func:`ctm_plugin.color.dssim.dssim`."""
    return DSSIM.apply(image, target)


class DSSIM(torch.autograd.Function):
    """The loss; its gradient is found with it."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> Tensor:
        a, b = image.detach().contiguous(), target.detach().contiguous()
        channels, height, width = a.shape
        if min(height, width) < WINDOW:
            ctx.save_for_backward(torch.zeros_like(a))
            return a.new_zeros(())
        places = torch.arange(WINDOW) - WINDOW // 2
        line = torch.exp(-places.square() / 4.5)
        line = (line / line.sum()).float()
        inner = (channels, height - WINDOW + 1, width - WINDOW + 1)
        rows, slopes = torch.empty(5, channels, height, inner[2]), torch.empty(3, *inner)
        sums, grad = torch.empty(channels, inner[1]), torch.empty_like(a)
        blur_rows(a, b, line, rows)
        compare(rows, line, slopes, sums)
        spread_columns(slopes, line, rows)
        spread_rows(a, b, line, rows, -1.0 / slopes[0].numel(), grad)
        ctx.save_for_backward(grad)
        return 1 - sums.double().sum().float() / slopes[0].numel()

    @staticmethod
    def backward(ctx: Any, d_loss: Tensor) -> tuple[Tensor, None]:
        (grad,) = ctx.saved_tensors
        return d_loss * grad, None


@compiled("void(f4[:,:,::1], f4[:,:,::1], f4[::1], f4[:,:,:,::1])", fused=True)
def blur_rows(a, b, line, rows):
    """Blur a, b, a^2, b^2 and ab along rows: ``[5, C, H, W - 10]``."""
    _, channels, height, wide = rows.shape
    for each in prange(channels * height):
        c, y = each // height, each % height
        x, z = a[c, y], b[c, y]
        for out in range(5):
            row = rows[out, c, y]
            row[:] = np.float32(0)
            for tap in range(WINDOW):
                weight = line[tap]
                for i in range(wide):
                    if out == 0:
                        row[i] += weight * x[i + tap]
                    elif out == 1:
                        row[i] += weight * z[i + tap]
                    elif out == 2:
                        row[i] += weight * x[i + tap] * x[i + tap]
                    elif out == 3:
                        row[i] += weight * z[i + tap] * z[i + tap]
                    else:
                        row[i] += weight * x[i + tap] * z[i + tap]


@compiled("void(f4[:,:,:,::1], f4[::1], f4[:,:,:,::1], f4[:,::1])", fused=True)
def compare(rows, line, slopes, sums):
    """Blur along columns; sum the similarity of each row up, and take its slopes in the means of a, a^2 and ab."""
    _, channels, high, wide = slopes.shape
    for each in prange(channels * high):
        c, y = each // high, each % high
        found = np.zeros((5, wide), np.float32)
        for out in range(5):
            for tap in range(WINDOW):
                weight, row, into = line[tap], rows[out, c, y + tap], found[out]
                for i in range(wide):
                    into[i] += weight * row[i]
        total = np.float32(0)
        for i in range(wide):
            ma, mb = found[0, i], found[1, i]
            over, under = TWO * ma * mb + C1, ma * ma + mb * mb + C1
            same, all_of = TWO * (found[4, i] - ma * mb) + C2, found[2, i] - ma * ma + found[3, i] - mb * mb + C2
            similar = over * same / (under * all_of)
            total += similar
            slopes[0, c, y, i] = TWO * (
                mb * (same - over) / (under * all_of) - similar * ma / under + similar * ma / all_of
            )
            slopes[1, c, y, i] = -similar / all_of
            slopes[2, c, y, i] = TWO * over / (under * all_of)
        sums[c, y] = total


@compiled("void(f4[:,:,:,::1], f4[::1], f4[:,:,:,::1])", fused=True)
def spread_columns(slopes, line, rows):
    """Take the slopes back along columns, into the first three of ``rows``."""
    _, channels, high, wide = slopes.shape
    height = high + WINDOW - 1
    for each in prange(channels * height):
        c, y = each // height, each % height
        for out in range(3):
            into = rows[out, c, y]
            into[:] = np.float32(0)
            for tap in range(max(0, y - high + 1), min(WINDOW, y + 1)):
                weight, row = line[tap], slopes[out, c, y - tap]
                for i in range(wide):
                    into[i] += weight * row[i]


@compiled("void(f4[:,:,::1], f4[:,:,::1], f4[::1], f4[:,:,:,::1], f8, f4[:,:,::1])", fused=True)
def spread_rows(a, b, line, rows, scale, grad):
    """And along rows: ``scale (s_a + 2 a s_aa + b s_ab)``."""
    channels, height, width = a.shape
    wide, factor = rows.shape[3], np.float32(scale)
    for each in prange(channels * height):
        c, y = each // height, each % height
        found = np.zeros((3, width), np.float32)
        for out in range(3):
            row, into = rows[out, c, y], found[out]
            for tap in range(WINDOW):
                weight = line[tap]
                for i in range(wide):
                    into[i + tap] += weight * row[i]
        for i in range(width):
            grad[c, y, i] = factor * (found[0, i] + TWO * a[c, y, i] * found[1, i] + b[c, y, i] * found[2, i])
