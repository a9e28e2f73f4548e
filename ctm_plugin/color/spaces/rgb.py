"""Plain sRGB."""

from __future__ import annotations

from ctm_plugin.color.srgb import Colors
from ctm_plugin.color.transform import ColorTransform


class Space(ColorTransform):
    """The identity; decoding clips to [0, 1]."""

    def encode(self, rgb: Colors) -> Colors:
        return rgb

    def decode(self, latent: Colors) -> Colors:
        return latent.clamp(0.0, 1.0)
