"""Pinhole cameras: pixels to rays."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor


class Rays(NamedTuple):
    """``r(t) = origin + t direction``, directions of unit length: t is a distance in scene units.

    Attributes:
        origins, directions: ``[R, 3]``.
    """

    origins: Float[Tensor, "r 3"]
    directions: Float[Tensor, "r 3"]

    def __getitem__(self, index) -> Rays:
        return Rays(self.origins[index], self.directions[index])


def camera_rays(c2w: Float[Tensor, "r 3 4"], intrinsics: Float[Tensor, "r 4"], x: Tensor, y: Tensor) -> Rays:
    """Rays through image points of OpenGL cameras (x right, y up, looking along -z).

    The direction in the camera's frame is ``((x - cx) / fx, -(y - cy) / fy, -1)``, normalised.

    Args:
        c2w: camera to world, one a ray.
        intrinsics: (fx, fy, cx, cy) in pixels, one a ray.
        x, y: ``[R]`` in pixels, the first pixel's centre at 0.5.
    """
    fx, fy, cx, cy = intrinsics.unbind(-1)
    local = torch.stack([(x - cx) / fx, -(y - cy) / fy, -torch.ones_like(x)], dim=-1)
    # No matrix product: autocast would round the directions to half precision.
    directions = (c2w[..., :3] * local[:, None, :]).sum(-1)
    return Rays(c2w[..., 3], directions / directions.norm(dim=-1, keepdim=True))


def pixel_rays(
    c2w: Float[Tensor, "n 3 4"], intrinsics: Float[Tensor, "n 4"], height: int, width: int, pixel: Int[Tensor, " r"]
) -> Rays:
    """Rays through pixel centres, by flat index ``(view * height + row) * width + column``."""
    view = pixel.div(height * width, rounding_mode="floor")
    row = pixel.div(width, rounding_mode="floor") % height
    column = pixel % width
    return camera_rays(c2w[view], intrinsics[view], column + 0.5, row + 0.5)
