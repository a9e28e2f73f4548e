"""HLS with hue and saturation as Cartesian coordinates, scaled to [0, 1]: no jump at hue 0."""

from __future__ import annotations

import torch

from ctm_plugin.color.hue import from_disc, to_disc
from ctm_plugin.color.spaces import hls
from ctm_plugin.color.srgb import Colors, channels_of


class Space(hls.Space):
    def encode(self, rgb: Colors) -> Colors:
        hue, lightness, saturation = super().encode(rgb).unbind(-1)
        x, y = to_disc(hue, saturation)
        return torch.stack([x, lightness, y], dim=-1)

    def decode(self, latent: Colors) -> Colors:
        """Points outside the disc are moved to its rim."""
        x, lightness, y = channels_of(latent)
        hue, saturation = from_disc(x, y)
        return super().decode(torch.stack([hue, lightness, saturation], dim=-1))
