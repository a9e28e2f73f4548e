"""Loop of structural dissimilarity (D-SSIM) with its gradient, in one pass over bands of rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from ctm_plugin.cpu.compiled import compiled, fused_part

WINDOW, SIGMA = 11, 1.5
C1, C2, ONE, TWO, ZERO = (np.float32(value) for value in (0.01**2, 0.03**2, 1, 2, 0))
BAND_ROWS = 64
"""Rows of the gradient that are computed together; the rows around them are blurred once more."""
_line = np.exp(-(np.arange(6.0) ** 2) / (2 * SIGMA**2))
W0, W1, W2, W3, W4, W5 = (np.float32(value) for value in _line / (2 * _line.sum() - 1))
"""The window's weights from the middle outwards."""


def dssim(image: Tensor, target: Tensor) -> Tensor:
    """One minus the mean SSIM of two pictures, see :func:`ctm_plugin.color.dssim.dssim`."""
    return DSSIM.apply(image, target)


class DSSIM(torch.autograd.Function):
    """Autograd function of :func:`dssim`, which computes the gradient together with the loss."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> Tensor:
        a, b = image.detach().contiguous(), target.detach().contiguous()
        channels, height, width = a.shape
        if min(height, width) < WINDOW:
            ctx.save_for_backward(torch.zeros_like(a))
            return a.new_zeros(())
        high, wide = height - WINDOW + 1, width - WINDOW + 1
        sums, grad = torch.empty(channels, high), torch.empty_like(a)
        compare(a, b, -1.0 / (channels * high * wide), sums, grad)
        ctx.save_for_backward(grad)
        return 1 - sums.double().sum().float() / (channels * high * wide)

    @staticmethod
    def backward(ctx: Any, d_loss: Tensor) -> tuple[Tensor, None]:
        (grad,) = ctx.saved_tensors
        return d_loss * grad, None


@fused_part
def _along(row, into, count):
    """Blur a row of ``count + 10`` numbers."""
    for i in range(count):
        into[i] = (
            W0 * row[i + 5] + W1 * (row[i + 4] + row[i + 6]) + W2 * (row[i + 3] + row[i + 7])
            + W3 * (row[i + 2] + row[i + 8]) + W4 * (row[i + 1] + row[i + 9]) + W5 * (row[i] + row[i + 10])
        )  # fmt: skip


@fused_part
def _pair(one, other, weight, into, count):
    for i in range(count):
        into[i] += weight * (one[i] + other[i])


@fused_part
def _across(rows, y, into, count):
    """Blur rows y to y + 10 of a ring of eleven, ``[11, count]``, into one."""
    middle = rows[(y + 5) % WINDOW]
    for i in range(count):
        into[i] = W0 * middle[i]
    _pair(rows[(y + 4) % WINDOW], rows[(y + 6) % WINDOW], W1, into, count)
    _pair(rows[(y + 3) % WINDOW], rows[(y + 7) % WINDOW], W2, into, count)
    _pair(rows[(y + 2) % WINDOW], rows[(y + 8) % WINDOW], W3, into, count)
    _pair(rows[(y + 1) % WINDOW], rows[(y + 9) % WINDOW], W4, into, count)
    _pair(rows[y % WINDOW], rows[(y + 10) % WINDOW], W5, into, count)


@fused_part
def _products(x, z, into, count):
    """Write the squares of two rows of pixels, and their product."""
    for i in range(count):
        into[0, i], into[1, i], into[2, i] = x[i] * x[i], z[i] * z[i], x[i] * z[i]


@fused_part
def _similarity(blurred, first, second, third, count):
    """Sum the similarity of a row of windows up, and write its slopes in the means of a, a^2 and ab."""
    total = ZERO
    for i in range(count):
        ma, mb = blurred[0, i], blurred[1, i]
        over, under = TWO * ma * mb + C1, ma * ma + mb * mb + C1
        same, all_of = TWO * (blurred[4, i] - ma * mb) + C2, blurred[2, i] - ma * ma + blurred[3, i] - mb * mb + C2
        per_under, per_all = ONE / under, ONE / all_of
        each = per_under * per_all
        similar = over * same * each
        total += similar
        first[i] = TWO * (mb * (same - over) * each - similar * ma * per_under + similar * ma * per_all)
        second[i] = -similar * per_all
        third[i] = TWO * over * each
    return total


@compiled("void(f4[:,:,::1], f4[:,:,::1], f8, f4[:,::1], f4[:,:,::1])", fused=True)
def compare(a, b, scale, sums, grad):
    """Compare two pictures ``[C, H, W]``, each channel in bands of rows.

    A row's slopes s are blurred back onto the rows that its windows see: ``grad = scale (s_a + 2 a s_aa + b s_ab)``.

    Args:
        a, b: the pictures.
        scale: factor on the gradient.
        sums: ``[C, H - 10]``, left with the sum of the similarities of each row of windows.
        grad: ``[C, H, W]``, left with the gradient in ``a``.
    """
    channels, height, width = a.shape
    high, wide, factor = height - WINDOW + 1, width - WINDOW + 1, np.float32(scale)
    bands = (height + BAND_ROWS - 1) // BAND_ROWS
    for part in prange(channels * bands):
        c, top = part // bands, part % bands * BAND_ROWS
        bottom = min(top + BAND_ROWS, height)
        rows, slopes = np.empty((5, WINDOW, wide), np.float32), np.zeros((3, WINDOW, wide), np.float32)
        products, blurred = np.empty((3, width), np.float32), np.empty((5, wide), np.float32)
        spread, found = np.zeros((3, width + WINDOW - 1), np.float32), np.empty((3, width), np.float32)
        first = max(top - WINDOW + 1, 0)
        made = first
        for y in range(first, bottom):
            if y < high:
                while made < y + WINDOW:
                    _products(a[c, made], b[c, made], products, width)
                    at = made % WINDOW
                    _along(a[c, made], rows[0, at], wide)
                    _along(b[c, made], rows[1, at], wide)
                    for out in range(3):
                        _along(products[out], rows[2 + out, at], wide)
                    made += 1
                for out in range(5):
                    _across(rows[out], y, blurred[out], wide)
                at = y % WINDOW
                total = _similarity(blurred, slopes[0, at], slopes[1, at], slopes[2, at], wide)
                if y >= top:
                    sums[c, y] = total
            else:  # below the last window
                slopes[:, y % WINDOW] = ZERO
            if y >= top:
                for out in range(3):
                    _across(slopes[out], y + 1, spread[out, WINDOW - 1 : width], wide)
                    _along(spread[out], found[out], width)
                for i in range(width):
                    grad[c, y, i] = factor * (found[0, i] + TWO * a[c, y, i] * found[1, i] + b[c, y, i] * found[2, i])
