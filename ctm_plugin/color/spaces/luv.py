"""CIE L*u*v*, scaled to [0, 1]."""

from __future__ import annotations

import torch

from ctm_plugin.color.srgb import Colors, channels_of
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.color.xyz import CUBE_FROM, D65_WHITE, cube_root, from_xyz, to_xyz

DARK_SLOPE = 903.3
"""Slope of L* over Y near black (CIE's kappa)."""

# Chromaticities (u', v') of sRGB's triangle, rounded outwards. Points outside are moved in before decoding.
WHITE_U = 4.0 * D65_WHITE[0] / (D65_WHITE[0] + 15.0 * D65_WHITE[1] + 3.0 * D65_WHITE[2])
"""Chromaticity u', v' of the white point."""
WHITE_V = 9.0 * D65_WHITE[1] / (D65_WHITE[0] + 15.0 * D65_WHITE[1] + 3.0 * D65_WHITE[2])
U_RANGE = (0.12, 0.46)
"""Ranges of u' and v' that the chromaticities of the sRGB gamut lie in."""
V_RANGE = (0.15, 0.57)


class Space(ColorTransform):
    def encode(self, rgb: Colors) -> Colors:
        """``u* = 13 L* (u' - u'n), v* = 13 L* (v' - v'n)`` with ``u' = 4 X / D, v' = 9 Y / D, D = X + 15 Y + 3 Z``.

        ``L*`` as in Lab, with slope 903.3 in the dark. Black is (0, u* = 0, v* = 0).
        """
        x, y, z = to_xyz(rgb)
        lightness = torch.where(y > CUBE_FROM, 116.0 * cube_root(y) - 16.0, DARK_SLOPE * y)
        total = (x + 15.0 * y + 3.0 * z).clamp(min=1e-12)
        u = 13.0 * lightness * (4.0 * x / total - WHITE_U)
        v = 13.0 * lightness * (9.0 * y / total - WHITE_V)
        return torch.stack([lightness / 100.0, (u + 134.0) / 354.0, (v + 140.0) / 262.0], dim=-1)

    def decode(self, luv: Colors) -> Colors:
        """Invert :meth:`encode`; chromaticities outside sRGB's ranges are moved in, other values clipped."""
        scaled, u, v = channels_of(luv)
        lightness = 100.0 * scaled
        chroma_scale = 13.0 * lightness.clamp(min=1e-4)
        u_prime = ((354.0 * u - 134.0) / chroma_scale + WHITE_U).clamp(*U_RANGE)
        v_prime = ((262.0 * v - 140.0) / chroma_scale + WHITE_V).clamp(*V_RANGE)
        y = torch.where(lightness > DARK_SLOPE * CUBE_FROM, ((lightness + 16.0) / 116.0) ** 3, lightness / DARK_SLOPE)
        x = y * 9.0 * u_prime / (4.0 * v_prime)
        z = y * (12.0 - 3.0 * u_prime - 20.0 * v_prime) / (4.0 * v_prime)
        return from_xyz([x, y, z])
