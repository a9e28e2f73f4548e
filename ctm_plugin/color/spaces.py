"""Handcrafted colour spaces (Table 2 of the paper): fixed maps between sRGB and seven spaces, all scaled to [0, 1].

| name     | channel 0         | channel 1             | channel 2         |
|----------|-------------------|-----------------------|-------------------|
| rgb      | R                 | G                     | B                 |
| hsv      | hue in turns      | saturation            | value             |
| hls      | hue in turns      | lightness             | saturation        |
| hsv_cart | (1 + s cos h) / 2 | (1 + s sin h) / 2     | value             |
| hls_cart | (1 + s cos h) / 2 | lightness             | (1 + s sin h) / 2 |
| lab      | L* / 100          | (a* + 128) / 255      | (b* + 128) / 255  |
| luv      | L* / 100          | (u* + 134) / 354      | (v* + 140) / 262  |

Every function takes and returns ``[..., 3]``, computes in float32 (float64 stays), and has finite gradients everywhere,
on grey, black and white too. Decoding takes any point of [0, 1]^3, as a field may render any, and clips to [0, 1].

Sources: hue spaces, Smith 1978 and https://en.wikipedia.org/wiki/HSL_and_HSV; Lab and Luv, CIE 15 with white D65 (2
degrees) and scikit-image's constants; their scales are OpenCV's for 8-bit images. kornia has the same formulas, but
converts through matrix products, which run in half precision under autocast and in TF32 on a GPU.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear

Colors = Float[Tensor, "*n 3"]

# Chroma, value and lightness below this are told from 0 no more: bounds the gradients of their quotients by 1e6.
EPSILON = 1e-6

RGB_TO_XYZ = ((0.412453, 0.357580, 0.180423), (0.212671, 0.715160, 0.072169), (0.019334, 0.119193, 0.950227))
XYZ_TO_RGB = tuple(map(tuple, np.linalg.inv(RGB_TO_XYZ).tolist()))
WHITE = (0.95047, 1.0, 1.08883)

# CIE's rounded constants, with which both pieces of f meet to 1e-6.
CUBE_FROM = 0.008856
SLOPE = 7.787
OFFSET = 16.0 / 116.0
DARK_SLOPE = 903.3

# Chromaticities (u', v') of sRGB's triangle, rounded outwards. Points outside are moved in before decoding.
WHITE_U = 4.0 * WHITE[0] / (WHITE[0] + 15.0 * WHITE[1] + 3.0 * WHITE[2])
WHITE_V = 9.0 * WHITE[1] / (WHITE[0] + 15.0 * WHITE[1] + 3.0 * WHITE[2])
U_RANGE = (0.12, 0.46)
V_RANGE = (0.15, 0.57)


class Space(NamedTuple):
    """A colour space: ``encode`` from sRGB in [0, 1]^3 into it, ``decode`` back, both on ``[..., 3]``."""

    name: str
    encode: Callable[[Tensor], Tensor]
    decode: Callable[[Tensor], Tensor]


def rgb_encode(rgb: Colors) -> Colors:
    """The identity."""
    return rgb


def rgb_decode(latent: Colors) -> Colors:
    """The identity, clipped to [0, 1]."""
    return latent.clamp(0.0, 1.0)


def hsv_encode(rgb: Colors) -> Colors:
    """``v = max, s = (max - min) / max``, hue by sextant; (0, 0, v) for greys."""
    hue, low, high = _hue(rgb)
    return torch.stack([hue, (high - low) / high.clamp(min=EPSILON), high], dim=-1)


def hsv_decode(hsv: Colors) -> Colors:
    """``c = v - v s max(0, min(k, 4 - k, 1))`` with ``k = (n + 6 h) mod 6``, n = 5, 3, 1 for r, g, b."""
    hue, saturation, value = _channels(hsv)
    k = [(n + 6.0 * hue) % 6.0 for n in (5.0, 3.0, 1.0)]
    rgb = [value * (1.0 - saturation * torch.minimum(x, 4.0 - x).clamp(0.0, 1.0)) for x in k]
    return torch.stack(rgb, dim=-1).clamp(0.0, 1.0)


def hls_encode(rgb: Colors) -> Colors:
    """``l = (max + min) / 2, s = (max - min) / (1 - |2 l - 1|)``, hue by sextant; (0, l, 0) for greys."""
    hue, low, high = _hue(rgb)
    lightness = (high + low) / 2.0
    room = 2.0 * torch.minimum(lightness, 1.0 - lightness)
    return torch.stack([hue, lightness, (high - low) / room.clamp(min=EPSILON)], dim=-1)


def hls_decode(hls: Colors) -> Colors:
    """``c = l - s min(l, 1 - l) max(-1, min(k - 3, 9 - k, 1))`` with ``k = (n + 12 h) mod 12``, n = 0, 8, 4."""
    hue, lightness, saturation = _channels(hls)
    amplitude = saturation * torch.minimum(lightness, 1.0 - lightness)
    k = [(n + 12.0 * hue) % 12.0 for n in (0.0, 8.0, 4.0)]
    rgb = [lightness - amplitude * torch.minimum(x - 3.0, 9.0 - x).clamp(-1.0, 1.0) for x in k]
    return torch.stack(rgb, dim=-1).clamp(0.0, 1.0)


def hsv_cart_encode(rgb: Colors) -> Colors:
    """:func:`hsv_encode` with (hue, saturation) in Cartesian coordinates: no jump at hue 0."""
    hue, saturation, value = hsv_encode(rgb).unbind(-1)
    x, y = _to_disc(hue, saturation)
    return torch.stack([x, y, value], dim=-1)


def hsv_cart_decode(latent: Colors) -> Colors:
    """Inverse of :func:`hsv_cart_encode`; points outside the disc are moved to its rim."""
    x, y, value = _channels(latent)
    hue, saturation = _from_disc(x, y)
    return hsv_decode(torch.stack([hue, saturation, value], dim=-1))


def hls_cart_encode(rgb: Colors) -> Colors:
    """:func:`hls_encode` with (hue, saturation) in Cartesian coordinates: no jump at hue 0."""
    hue, lightness, saturation = hls_encode(rgb).unbind(-1)
    x, y = _to_disc(hue, saturation)
    return torch.stack([x, lightness, y], dim=-1)


def hls_cart_decode(latent: Colors) -> Colors:
    """Inverse of :func:`hls_cart_encode`; points outside the disc are moved to its rim."""
    x, lightness, y = _channels(latent)
    hue, saturation = _from_disc(x, y)
    return hls_decode(torch.stack([hue, lightness, saturation], dim=-1))


def lab_encode(rgb: Colors) -> Colors:
    """``L* = 116 f(Y) - 16, a* = 500 (f(X/Xn) - f(Y)), b* = 200 (f(Y) - f(Z/Zn))``.

    ``f(t)`` is the cube root, and a line below t = 0.008856.
    """
    fx, fy, fz = (_f(value / white) for value, white in zip(_to_xyz(rgb), WHITE, strict=True))
    return torch.stack(
        [(116.0 * fy - 16.0) / 100.0, (500.0 * (fx - fy) + 128.0) / 255.0, (200.0 * (fy - fz) + 128.0) / 255.0], dim=-1
    )


def lab_decode(lab: Colors) -> Colors:
    """Inverse of :func:`lab_encode`; colours outside sRGB are clipped."""
    lightness, a, b = _channels(lab)
    fy = (100.0 * lightness + 16.0) / 116.0
    fx = fy + (255.0 * a - 128.0) / 500.0
    fz = fy - (255.0 * b - 128.0) / 200.0
    return _from_xyz([_f_inverse(value) * white for value, white in zip((fx, fy, fz), WHITE, strict=True)])


def luv_encode(rgb: Colors) -> Colors:
    """``u* = 13 L* (u' - u'n), v* = 13 L* (v' - v'n)`` with ``u' = 4 X / D, v' = 9 Y / D, D = X + 15 Y + 3 Z``.

    ``L*`` as in Lab, with slope 903.3 in the dark. Black is (0, u* = 0, v* = 0).
    """
    x, y, z = _to_xyz(rgb)
    lightness = torch.where(y > CUBE_FROM, 116.0 * _cube_root(y) - 16.0, DARK_SLOPE * y)
    total = (x + 15.0 * y + 3.0 * z).clamp(min=1e-12)
    u = 13.0 * lightness * (4.0 * x / total - WHITE_U)
    v = 13.0 * lightness * (9.0 * y / total - WHITE_V)
    return torch.stack([lightness / 100.0, (u + 134.0) / 354.0, (v + 140.0) / 262.0], dim=-1)


def luv_decode(luv: Colors) -> Colors:
    """Inverse of :func:`luv_encode`; chromaticities outside sRGB's are moved in, the rest is clipped."""
    scaled, u, v = _channels(luv)
    lightness = 100.0 * scaled
    chroma_scale = 13.0 * lightness.clamp(min=1e-4)
    u_prime = ((354.0 * u - 134.0) / chroma_scale + WHITE_U).clamp(*U_RANGE)
    v_prime = ((262.0 * v - 140.0) / chroma_scale + WHITE_V).clamp(*V_RANGE)
    y = torch.where(lightness > DARK_SLOPE * CUBE_FROM, ((lightness + 16.0) / 116.0) ** 3, lightness / DARK_SLOPE)
    x = y * 9.0 * u_prime / (4.0 * v_prime)
    z = y * (12.0 - 3.0 * u_prime - 20.0 * v_prime) / (4.0 * v_prime)
    return _from_xyz([x, y, z])


SPACES: dict[str, Space] = {
    space.name: space
    for space in (
        Space("rgb", rgb_encode, rgb_decode),
        Space("hls", hls_encode, hls_decode),
        Space("hsv", hsv_encode, hsv_decode),
        Space("hls_cart", hls_cart_encode, hls_cart_decode),
        Space("hsv_cart", hsv_cart_encode, hsv_cart_decode),
        Space("lab", lab_encode, lab_decode),
        Space("luv", luv_encode, luv_decode),
    )
}


def _channels(colors: Tensor) -> tuple[Tensor, ...]:
    """The three channels, in float32 at least: half precision cannot tell dark colours apart."""
    return (colors if colors.dtype == torch.float64 else colors.float()).unbind(-1)


def _hue(rgb: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Hue in turns, [0, 1], 0 for greys; smallest and largest channel."""
    red, green, blue = _channels(rgb)
    high = torch.maximum(torch.maximum(red, green), blue)
    low = torch.minimum(torch.minimum(red, green), blue)
    chroma = (high - low).clamp(min=EPSILON)
    is_red, is_green = red == high, green == high
    difference = torch.where(is_red, green - blue, torch.where(is_green, blue - red, red - green))
    start = torch.where(is_red, 0.0, torch.where(is_green, 2.0, 4.0))
    return ((difference / chroma + start) / 6.0) % 1.0, low, high


def _to_disc(hue: Tensor, saturation: Tensor) -> tuple[Tensor, Tensor]:
    angle = 2.0 * math.pi * hue
    return (1.0 + saturation * angle.cos()) / 2.0, (1.0 + saturation * angle.sin()) / 2.0


def _from_disc(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    x, y = 2.0 * x - 1.0, 2.0 * y - 1.0
    # At the centre neither the root nor the angle has a gradient; keep both away from it, in backward too.
    centre = x.square() + y.square() < EPSILON**2
    x, y = torch.where(centre, 1.0, x), torch.where(centre, 0.0, y)
    radius = torch.where(centre, 0.0, (x.square() + y.square()).sqrt())
    return torch.atan2(y, x) / (2.0 * math.pi) % 1.0, radius.clamp(max=1.0)


def _to_xyz(rgb: Tensor) -> list[Tensor]:
    return _product(RGB_TO_XYZ, [srgb_to_linear(channel) for channel in _channels(rgb)])


def _from_xyz(xyz: list[Tensor]) -> Tensor:
    linear = torch.stack(_product(XYZ_TO_RGB, xyz), dim=-1).clamp(0.0, 1.0)
    return linear_to_srgb(linear).clamp(0.0, 1.0)


def _product(matrix: tuple[tuple[float, ...], ...], vector: list[Tensor]) -> list[Tensor]:
    """Written out, because a matrix product obeys autocast and TF32."""
    return [sum(weight * value for weight, value in zip(row, vector, strict=True)) for row in matrix]


def _cube_root(t: Tensor) -> Tensor:
    """For t > CUBE_FROM; the clamp keeps the gradient of the branch not taken finite."""
    return t.clamp(min=CUBE_FROM) ** (1.0 / 3.0)


def _f(t: Tensor) -> Tensor:
    return torch.where(t > CUBE_FROM, _cube_root(t), SLOPE * t + OFFSET)


def _f_inverse(t: Tensor) -> Tensor:
    return torch.where(t > CUBE_FROM ** (1.0 / 3.0), t**3, (t - OFFSET) / SLOPE)
