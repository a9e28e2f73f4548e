"""Lenses whose distortion can be undone: the others are refused before anything is trained."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from ctm_plugin.check import Number
from ctm_plugin.errors import DataError
from ctm_plugin.rays.cameras import distort, distortion_slopes, undistort

PINHOLE = (0.0, 0.0, 0.0, 0.0, 0.0)
"""(k1, k2, p1, p2, k3) of a lens that does not distort."""
TOLERANCE = 1e-6
"""How well the inverse must hit, in units of the focal length: a hundredth of a pixel at a focal length of 10,000."""
LEAST_DETERMINANT = 1e-3
"""How much a small area may shrink: near zero the lens folds."""


def check_lens(
    distortion: Sequence[Number],
    intrinsics: Sequence[Number],
    height: int,
    width: int,
    source: Path,
    where: str,
    points: int = 49,
) -> None:
    """Refuse a lens that does not map one to one inside the image, for which its pixels have no rays.

    A grid of ``points`` x ``points`` image points, edges included, must be undone to ``TOLERANCE``; and between the
    axis and each of their sources, at eight places, the determinant of the mapping's derivative must stay positive.

    Args:
        distortion: (k1, k2, p1, p2, k3).
        intrinsics: (fx, fy, cx, cy) in pixels.
        height, width: of the image in pixels.
        source, where: the file and the place in it, for the message.

    Raises:
        DataError: it does not.
    """
    lens = torch.tensor(distortion, dtype=torch.float64)
    fx, fy, cx, cy = intrinsics
    x = ((torch.linspace(0, width, points, dtype=torch.float64) - cx) / fx).repeat(points)
    y = ((torch.linspace(0, height, points, dtype=torch.float64) - cy) / fy).repeat_interleave(points)
    u, v = undistort(x, y, lens)
    back_x, back_y = distort(u, v, lens)
    off = torch.maximum((back_x - x).abs(), (back_y - y).abs()).max()
    part = torch.linspace(0, 1, 9, dtype=torch.float64)[:, None]
    xx, xy, yy = distortion_slopes(part * u, part * v, lens)
    # Comparisons that NaN fails.
    if not (off <= TOLERANCE and (xx * yy - xy * xy >= LEAST_DETERMINANT).all()):
        found = f"{where} with distortion (k1, k2, p1, p2, k3) = ({', '.join(f'{value:g}' for value in distortion)})"
        raise DataError(source, found, "a lens that maps one to one inside the image")
