"""HSV: hue, saturation, value, scaled to [0, 1]."""

from __future__ import annotations

import torch

from ctm_plugin.color.hue import EPSILON, hue_of
from ctm_plugin.color.srgb import Colors, channels_of
from ctm_plugin.color.transform import ColorTransform


class Space(ColorTransform):
    def encode(self, rgb: Colors) -> Colors:
        """``v = max, s = (max - min) / max``, hue by sextant; (0, 0, v) for greys."""
        hue, low, high = hue_of(rgb)
        return torch.stack([hue, (high - low) / high.clamp(min=EPSILON), high], dim=-1)

    def decode(self, hsv: Colors) -> Colors:
        """``c = v - v s max(0, min(k, 4 - k, 1))`` with ``k = (n + 6 h) mod 6``, n = 5, 3, 1 for r, g, b."""
        hue, saturation, value = channels_of(hsv)
        k = [(n + 6.0 * hue) % 6.0 for n in (5.0, 3.0, 1.0)]
        rgb = [value * (1.0 - saturation * torch.minimum(x, 4.0 - x).clamp(0.0, 1.0)) for x in k]
        return torch.stack(rgb, dim=-1).clamp(0.0, 1.0)
