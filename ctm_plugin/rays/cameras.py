"""Cameras: pixels to rays, through pinholes and through lenses with OpenCV's distortion."""

from __future__ import annotations

import math
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

    def points(self, t: Float[Tensor, " m"], ray_index: Int[Tensor, " m"]) -> Float[Tensor, "m 3"]:
        """Find the positions of packed samples: ``origins[ray_index] + t directions[ray_index]``.

        One coordinate after another in memory (strides 1 and M): what follows takes them one by one.
        """
        index = ray_index.expand(3, -1)
        origins, directions = (each.T.gather(1, index) for each in self)
        return origins.addcmul_(directions, t).T


NEWTON_STEPS = 8
"""Newton steps of :func:`undistort`. A wide-angle lens needs four, a barrel close to where it folds six."""


def distort(x: Tensor, y: Tensor, distortion: Float[Tensor, "*r 5"]) -> tuple[Tensor, Tensor]:
    """Find where a lens images a point: OpenCV's polynomial in ``r² = x² + y²``, radial and tangential.

    ``x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²)``, and y' with x and y, p1 and p2 exchanged.

    Args:
        x, y: ``[...]`` point through a pinhole of focal length 1, from the axis, y down.
        distortion: ``[..., 5]`` (k1, k2, p1, p2, k3), of a shape that ``x`` broadcasts with.

    Returns:
        ``[...]`` x' and y'.
    """
    k1, k2, p1, p2, k3 = distortion.unbind(-1)
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    return (
        x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
        y * radial + 2 * p2 * x * y + p1 * (square + 2 * y * y),
    )


def distortion_slopes(x: Tensor, y: Tensor, distortion: Float[Tensor, "*r 5"]) -> tuple[Tensor, Tensor, Tensor]:
    """Differentiate :func:`distort`: ``dx'/dx``, ``dx'/dy = dy'/dx`` and ``dy'/dy``, ``[...]`` each."""
    k1, k2, p1, p2, k3 = distortion.unbind(-1)
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    slope = 2 * (k1 + square * (2 * k2 + square * 3 * k3))  # of radial: d radial / dx = slope x
    return (
        radial + slope * x * x + 2 * p1 * y + 6 * p2 * x,
        slope * x * y + 2 * p1 * x + 2 * p2 * y,
        radial + slope * y * y + 2 * p2 * x + 6 * p1 * y,
    )


def undistort(x: Tensor, y: Tensor, distortion: Float[Tensor, "*r 5"]) -> tuple[Tensor, Tensor]:
    """Find the point that a lens images at (x, y), ``[...]`` each: :func:`distort` undone by ``NEWTON_STEPS`` steps of
    Newton's.

    Only where the lens maps one to one, see :func:`ctm_plugin.data.readers.lens.check_lens`.
    """
    u, v = x, y
    for _ in range(NEWTON_STEPS):
        at_x, at_y = distort(u, v, distortion)
        xx, xy, yy = distortion_slopes(u, v, distortion)
        off_x, off_y, determinant = at_x - x, at_y - y, xx * yy - xy * xy
        u, v = u - (yy * off_x - xy * off_y) / determinant, v - (xx * off_y - xy * off_x) / determinant
    return u, v


def camera_rays(
    c2w: Float[Tensor, "r 3 4"],
    intrinsics: Float[Tensor, "r 4"],
    x: Tensor,
    y: Tensor,
    distortion: Float[Tensor, "r 5"] | None = None,
) -> Rays:
    """Make rays through image points of OpenGL cameras (x right, y up, looking along -z).

    The direction in the camera's frame is ``(u, -v, -1)``, normalised, with ``u = (x - cx) / fx`` and
    ``v = (y - cy) / fy``, undistorted where the lens distorts.

    Args:
        c2w: camera to world, one a ray.
        intrinsics: (fx, fy, cx, cy) in pixels, one a ray.
        x, y: ``[R]`` in pixels, the first pixel's centre at 0.5.
        distortion: (k1, k2, p1, p2, k3), one a ray; ``None`` for pinholes.
    """
    fx, fy, cx, cy = intrinsics.unbind(-1)
    u, v = (x - cx) / fx, (y - cy) / fy
    if distortion is not None:
        u, v = undistort(u, v, distortion)
    local = torch.stack([u, -v, -torch.ones_like(u)], dim=-1)
    # No matrix product: autocast would round the directions to half precision.
    directions = (c2w[..., :3] * local[:, None, :]).sum(-1)
    return Rays(c2w[..., 3], directions / directions.norm(dim=-1, keepdim=True))


def within_pixel(count: int) -> list[tuple[float, float, float]]:
    """Spread a square number of rays, k x k, over the middle quarter of a pixel: how far right and down of its centre
    each goes, in pixels, and how far into a stride its samples begin.

    ``(i + 1/2) / (2 k) - 1/4`` and the same with j; the strides' shares are the m + 1/2 of ``count``, far apart in rays
    next to each other.
    """
    side = math.isqrt(count)
    places = [(column + 0.5) / (2 * side) - 0.25 for column in range(side)]
    step = count // 2 + 1  # has no divisor in common with the count
    return [
        (places[index % side], places[index // side], (index * step % count + 0.5) / count) for index in range(count)
    ]


def pixel_rays(
    c2w: Float[Tensor, "n 3 4"],
    intrinsics: Float[Tensor, "n 4"],
    height: int,
    width: int,
    pixel: Int[Tensor, " r"],
    distortion: Float[Tensor, "n 5"] | None = None,
    right: float = 0.0,
    down: float = 0.0,
) -> Rays:
    """Make rays through pixel centres, by flat index ``(view * height + row) * width + column``; or through points
    ``right`` and ``down`` of these centres, in pixels.
    """
    view = pixel.div(height * width, rounding_mode="floor")
    row = pixel.div(width, rounding_mode="floor") % height
    column = pixel % width
    lens = None if distortion is None else distortion[view]
    return camera_rays(c2w[view], intrinsics[view], column + (0.5 + right), row + (0.5 + down), lens)
