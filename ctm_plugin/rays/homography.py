"""Homographies of the image plane as exponentials of sl(3), for planar alignment (Lin et al., BARF, ICCV 2021)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def sl3_exp(h: Float[Tensor, "*n 8"]) -> Float[Tensor, "*n 3 3"]:
    """Take ``exp(A)``, of determinant 1, with ``A = [[h5, h3, h1], [h4, -h5-h6, h2], [h7, h8, h6]]``.

    (h1, h2) move, (h3, h4) shear and turn, (h5, h6) scale, (h7, h8) tilt; 0 is the identity, -h the inverse.
    """
    h1, h2, h3, h4, h5, h6, h7, h8 = h.unbind(-1)
    rows = [h5, h3, h1, h4, -h5 - h6, h2, h7, h8, h6]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3)).matrix_exp()


def warp(points: Float[Tensor, "*n p 2"], matrix: Float[Tensor, "*m 3 3"]) -> Float[Tensor, "*k p 2"]:
    """Move points to ``(x / w, y / w)`` with ``(x, y, w) = M (x, y, 1)``; leading dimensions are broadcast.

    Args:
        points: P points for each homography.
        matrix: homographies; points with w = 0 go to infinity.
    """
    moved = points @ matrix[..., :2].transpose(-1, -2) + matrix[..., None, :, 2]
    return moved[..., :2] / moved[..., 2:]


def pixel_grid(height: int, width: int, patch: int | None = None) -> Float[Tensor, "h w 2"]:
    """List pixel centres ``(x, y)``, x to the right, y down, in units of half the longer side, 0 in the middle.

    Args:
        height, width: of the picture, in pixels.
        patch: side of the square in the middle that is wanted; ``None``: the whole picture.
    """
    axes = []
    for side in (height, width):
        first, count = (0, side) if patch is None else (side // 2 - patch // 2, patch)
        axes.append((2 * (first + torch.arange(count) + 0.5) - side) / max(height, width))
    y, x = torch.meshgrid(*axes, indexing="ij")
    return torch.stack([x, y], dim=-1)


def patch_corners(height: int, width: int, patch: int) -> Float[Tensor, "4 2"]:
    """List the corners of the square of ``patch`` pixels in the middle, in turn, in the units of :func:`pixel_grid`."""
    low = [(2 * (side // 2 - patch // 2) - side) / max(height, width) for side in (width, height)]
    (left, top), size = low, 2 * patch / max(height, width)
    return torch.tensor(
        [[left, top], [left, top + size], [left + size, top + size], [left + size, top]], dtype=torch.float32
    )


def to_pixels(points: Float[Tensor, "*n 2"], height: int, width: int) -> Float[Tensor, "*n 2"]:
    """Turn the units of :func:`pixel_grid` into pixels; the first pixel's centre is (0.5, 0.5)."""
    return (points * max(height, width) + points.new_tensor([width, height])) / 2
