"""Dark pictures brightened for people: one factor on linear light, found only from the training pictures."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from ctm_plugin.color.settings import MOST_STOPS
from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear

MEAN = 0.45
"""Of a lit picture's sRGB values: a little under the middle, where photographs of rooms and things lie."""
KNEE = 0.5
"""Linear light above which the shoulder bends: the last stop below white."""
LEAST = 2.0**0.5
"""Pictures that need less than half a stop are not brightened: they were lit."""
HALVINGS = 60
CHUNK = 1 << 20
"""Pixels counted at once."""


def shoulder(light: Float[Tensor, "*shape"], white: float) -> Float[Tensor, "*shape"]:
    """Bend bright light towards 1, so that lamps keep their shape instead of being clipped.

    Above the knee a = 0.5: ``a + (1 - a) t (1 + t / T^2) / (1 + t)`` with ``t = (x - a) / (1 - a)`` and T the same of
    ``white``, which is Reinhard et al. 2002, "Photographic Tone Reproduction for Digital Images", Eq. 4, moved to the
    knee. Below it the identity. Value and slope are continuous, black stays black, ``white`` becomes 1, and the curve
    rises all the way; as ``white`` grows it becomes ``a + (1 - a) t / (1 + t)``, whose limit is 1. For white <= 1 it is
    the identity.

    Args:
        light: linear, >= 0, any shape.
        white: what becomes 1, the brightest that there can be.

    Returns:
        The same shape, in [0, 1] for light in [0, max(white, 1)].
    """
    above = (light - KNEE).clamp(min=0) / (1 - KNEE)
    top = max(white - KNEE, 1 - KNEE) / (1 - KNEE)
    return light.clamp(max=KNEE) + (1 - KNEE) * above * (1 + above / top**2) / (1 + above)


def brighten(image: Float[Tensor, "*shape"], factor: float) -> Float[Tensor, "*shape"]:
    """Brighten an sRGB picture: sRGB -> linear, x factor, :func:`shoulder`, -> sRGB.

    Monotone in the picture and in the factor; 1 changes nothing.

    Args:
        image: sRGB in [0, 1], any shape; as rendered, not as rounded to 8 bits.
        factor: on linear light, > 0.

    Returns:
        sRGB in [0, 1], the same shape.
    """
    return linear_to_srgb(shoulder(srgb_to_linear(image) * factor, factor).clamp(0.0, 1.0))


def histogram(
    colors: UInt8[Tensor, "*shape c"] | Float[Tensor, "*shape c"], mask: Bool[Tensor, "*shape"] | None = None
) -> Int64[Tensor, " levels"]:
    """How often each level from 0 to 1 is among the colours: 256 of colours of 8 bits, 65536 of floats in [0, 1].

    Args:
        colors: sRGB, C = 3, or 4 with straight alpha: all channels of all pixels with alpha > 0 count.
        mask: which pixels count; ``None``: all do.
    """
    most = 255 if colors.dtype == torch.uint8 else 65535
    counts = torch.zeros(most + 1, dtype=torch.int64)
    rows = colors.detach().cpu().flatten(0, -2)
    counted = torch.ones(len(rows), dtype=torch.bool) if mask is None else mask.cpu().flatten()
    for part, counts_here in zip(rows.split(CHUNK), counted.split(CHUNK), strict=True):
        here = counts_here & (part[:, 3] > 0) if part.shape[1] == 4 else counts_here
        codes = part[here, :3]
        codes = codes if most == 255 else (codes * most).round().int()
        counts += torch.bincount(codes.flatten(), minlength=most + 1)
    return counts


def factor_to_mean(
    levels: Float[Tensor, " n"], counts: Tensor, mean: float = MEAN, most: float = 2.0**MOST_STOPS
) -> float:
    """The factor by which brightened colours have this mean, by bisection: the mean rises with the factor.

    Args:
        levels, counts: sRGB values in [0, 1] and how often each occurs, ``[n]``.
        mean: of sRGB values after :func:`brighten`.
        most: the largest factor.

    Returns:
        In [1, most]: 1 where the mean is reached as it is, and where all is black; ``most`` where it is out of reach.
    """
    seen = counts > 0  # few of the levels of floats
    levels, shares = levels[seen].double(), counts[seen].double() / counts.sum().clamp(min=1)
    now = float((levels * shares).sum())
    if now == 0.0 or now >= mean:
        return 1.0
    low, high = 0.0, math.log2(most)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        too_dark = float((brighten(levels, 2.0**middle) * shares).sum()) < mean
        low, high = (middle, high) if too_dark else (low, middle)
    return 2.0**high


def auto_factor(
    colors: UInt8[Tensor, "*shape c"] | Float[Tensor, "*shape c"], mask: Bool[Tensor, "*shape"] | None = None
) -> float:
    """The factor that brings training pictures to the mean :data:`MEAN`; 1 for those that are as bright, or nearly.

    Args:
        colors, mask: see :func:`histogram`.

    Returns:
        1, or at least half a stop (1.41).
    """
    counts = histogram(colors, mask)
    factor = factor_to_mean(torch.arange(len(counts)) / (len(counts) - 1), counts)
    return factor if factor >= LEAST else 1.0
