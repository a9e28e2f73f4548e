"""CIE XYZ between sRGB and the spaces that are made of it, and the constants of these."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ctm_plugin.color.srgb import channels_of, linear_to_srgb, srgb_to_linear

RGB_TO_XYZ = ((0.412453, 0.357580, 0.180423), (0.212671, 0.715160, 0.072169), (0.019334, 0.119193, 0.950227))
"""Matrix from linear sRGB to CIE XYZ (D65), and its inverse."""
XYZ_TO_RGB = tuple(map(tuple, np.linalg.inv(RGB_TO_XYZ).tolist()))
D65_WHITE = (0.95047, 1.0, 1.08883)
"""XYZ of D65, the white point of sRGB."""
CUBE_FROM = 0.008856
"""Y / Yn below which CIE has a line in place of the cube root."""


def to_xyz(rgb: Tensor) -> list[Tensor]:
    """Turn sRGB ``[..., 3]`` in [0, 1] into X, Y, Z ``[...]``, white having Y = 1."""
    return _product(RGB_TO_XYZ, [srgb_to_linear(channel) for channel in channels_of(rgb)])


def from_xyz(xyz: list[Tensor]) -> Tensor:
    """Turn X, Y, Z ``[...]`` into sRGB ``[..., 3]``, cut to [0, 1]."""
    linear = torch.stack(_product(XYZ_TO_RGB, xyz), dim=-1).clamp(0.0, 1.0)
    return linear_to_srgb(linear).clamp(0.0, 1.0)


def _product(matrix: tuple[tuple[float, ...], ...], vector: list[Tensor]) -> list[Tensor]:
    """Multiply matrix and vector, written out because torch's matrix product obeys autocast and TF32."""
    return [sum(weight * value for weight, value in zip(row, vector, strict=True)) for row in matrix]


def cube_root(t: Tensor) -> Tensor:
    """Cube root of ``[...]`` > CUBE_FROM; the clamp keeps the gradient of the branch not taken finite."""
    return t.clamp(min=CUBE_FROM) ** (1.0 / 3.0)
