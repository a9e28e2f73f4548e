"""sRGB times one number, fitted: the scene's range of colours in [0, 0.9]."""

from __future__ import annotations

from ctm_plugin.color.curves import Ranged


class Space(Ranged):
    """sRGB times one number, fitted: the scene's range of colours in [0, 0.9]."""
