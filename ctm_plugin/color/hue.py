"""Hue: of a colour, and with saturation as a point of a disc."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ctm_plugin.color.srgb import channels_of

# Chroma, value and lightness below this count as 0: bounds the gradients of their quotients by 1e6.
EPSILON = 1e-6


def hue_of(rgb: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Hue ``[...]`` of colours ``[..., 3]`` in turns, [0, 1], 0 for greys; smallest and largest channel."""
    red, green, blue = channels_of(rgb)
    high = torch.maximum(torch.maximum(red, green), blue)
    low = torch.minimum(torch.minimum(red, green), blue)
    chroma = (high - low).clamp(min=EPSILON)
    is_red, is_green = red == high, green == high
    difference = torch.where(is_red, green - blue, torch.where(is_green, blue - red, red - green))
    start = torch.where(is_red, 0.0, torch.where(is_green, 2.0, 4.0))
    return ((difference / chroma + start) / 6.0) % 1.0, low, high


def to_disc(hue: Tensor, saturation: Tensor) -> tuple[Tensor, Tensor]:
    """Turn polar coordinates ``[...]`` into x and y of a disc in [0, 1]^2; hue in turns, saturation in [0, 1]."""
    angle = 2.0 * math.pi * hue
    return (1.0 + saturation * angle.cos()) / 2.0, (1.0 + saturation * angle.sin()) / 2.0


def from_disc(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Invert :func:`to_disc`; what lies outside the disc has saturation 1."""
    x, y = 2.0 * x - 1.0, 2.0 * y - 1.0
    # At the centre neither the root nor the angle has a gradient; keep both away from it, in backward too.
    centre = x.square() + y.square() < EPSILON**2
    x, y = torch.where(centre, 1.0, x), torch.where(centre, 0.0, y)
    radius = torch.where(centre, 0.0, (x.square() + y.square()).sqrt())
    return torch.atan2(y, x) / (2.0 * math.pi) % 1.0, radius.clamp(max=1.0)
