"""HLS with hue and saturation as Cartesian coordinates, scaled to [0, 1]: no jump at hue 0."""

from __future__ import annotations

from ctm_plugin.color.hue import OnDisc
from ctm_plugin.color.spaces import hls


class Space(OnDisc, hls.Space):
    saturation = 2
