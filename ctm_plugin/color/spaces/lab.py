"""CIE L*a*b*, scaled to [0, 1]."""

from __future__ import annotations

import torch
from torch import Tensor

from ctm_plugin.color.srgb import Colors, channels_of
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.color.xyz import CUBE_FROM, D65_WHITE, cube_root, from_xyz, to_xyz

# CIE's rounded constants, with which both pieces of f meet to 1e-6.
LINEAR_SLOPE = 7.787
"""Slope and offset of CIE's line in place of the cube root near black."""
OFFSET = 16.0 / 116.0


class Space(ColorTransform):
    def encode(self, rgb: Colors) -> Colors:
        """``L* = 116 f(Y) - 16, a* = 500 (f(X/Xn) - f(Y)), b* = 200 (f(Y) - f(Z/Zn))``.

        ``f(t)`` is the cube root, and a line below t = 0.008856.
        """
        fx, fy, fz = (_f(value / white) for value, white in zip(to_xyz(rgb), D65_WHITE, strict=True))
        return torch.stack(
            [(116.0 * fy - 16.0) / 100.0, (500.0 * (fx - fy) + 128.0) / 255.0, (200.0 * (fy - fz) + 128.0) / 255.0],
            dim=-1,
        )

    def decode(self, lab: Colors) -> Colors:
        """Invert :meth:`encode`; colours outside sRGB's gamut are clipped."""
        lightness, a, b = channels_of(lab)
        fy = (100.0 * lightness + 16.0) / 116.0
        fx = fy + (255.0 * a - 128.0) / 500.0
        fz = fy - (255.0 * b - 128.0) / 200.0
        return from_xyz([_f_inverse(value) * white for value, white in zip((fx, fy, fz), D65_WHITE, strict=True)])


def _f(t: Tensor) -> Tensor:
    return torch.where(t > CUBE_FROM, cube_root(t), LINEAR_SLOPE * t + OFFSET)


def _f_inverse(t: Tensor) -> Tensor:
    return torch.where(t > CUBE_FROM ** (1.0 / 3.0), t**3, (t - OFFSET) / LINEAR_SLOPE)
