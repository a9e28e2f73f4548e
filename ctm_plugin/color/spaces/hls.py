"""HLS: hue, lightness, saturation, scaled to [0, 1]."""

from __future__ import annotations

import torch

from ctm_plugin.color.hue import EPSILON, hue_of
from ctm_plugin.color.srgb import Colors, channels_of
from ctm_plugin.color.transform import ColorTransform


class Space(ColorTransform):
    def encode(self, rgb: Colors) -> Colors:
        """``l = (max + min) / 2, s = (max - min) / (1 - |2 l - 1|)``, hue by sextant; (0, l, 0) for greys."""
        hue, low, high = hue_of(rgb)
        lightness = (high + low) / 2.0
        room = 2.0 * torch.minimum(lightness, 1.0 - lightness)
        return torch.stack([hue, lightness, (high - low) / room.clamp(min=EPSILON)], dim=-1)

    def decode(self, hls: Colors) -> Colors:
        """``c = l - s min(l, 1 - l) max(-1, min(k - 3, 9 - k, 1))`` with ``k = (n + 12 h) mod 12``, n = 0, 8, 4."""
        hue, lightness, saturation = channels_of(hls)
        amplitude = saturation * torch.minimum(lightness, 1.0 - lightness)
        k = [(n + 12.0 * hue) % 12.0 for n in (0.0, 8.0, 4.0)]
        rgb = [lightness - amplitude * torch.minimum(x - 3.0, 9.0 - x).clamp(-1.0, 1.0) for x in k]
        return torch.stack(rgb, dim=-1).clamp(0.0, 1.0)
