"""Hue: of a colour, and with saturation as a point of a disc."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ctm_plugin.color.srgb import Colors, channels_of
from ctm_plugin.color.transform import ColorTransform

# Chroma, value and lightness below this count as 0: bounds the gradients of their quotients by 1e6.
EPSILON = 1e-6
"""Least chroma and least value that a hue or a saturation is divided by."""


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


class OnDisc(ColorTransform):
    """A space with hue and saturation as Cartesian coordinates ``(1 + s cos h) / 2, (1 + s sin h) / 2``: no jump at 0.

    Mixin of a space with hue in channel 0 and saturation in channel ``saturation``. Points outside the disc decode as
    its rim.
    """

    saturation: int

    def encode(self, rgb: Colors) -> Colors:
        parts = list(super().encode(rgb).unbind(-1))
        angle, radius = 2.0 * math.pi * parts[0], parts[self.saturation]
        parts[0], parts[self.saturation] = (1.0 + radius * angle.cos()) / 2.0, (1.0 + radius * angle.sin()) / 2.0
        return torch.stack(parts, dim=-1)

    def decode(self, latent: Colors) -> Colors:
        parts = list(channels_of(latent))
        x, y = 2.0 * parts[0] - 1.0, 2.0 * parts[self.saturation] - 1.0
        # At the centre neither the root nor the angle has a gradient; keep both away from it, in backward too.
        centre = x.square() + y.square() < EPSILON**2
        x, y = torch.where(centre, 1.0, x), torch.where(centre, 0.0, y)
        radius = torch.where(centre, 0.0, (x.square() + y.square()).sqrt()).clamp(max=1.0)
        parts[0], parts[self.saturation] = torch.atan2(y, x) / (2.0 * math.pi) % 1.0, radius
        return super().decode(torch.stack(parts, dim=-1))
