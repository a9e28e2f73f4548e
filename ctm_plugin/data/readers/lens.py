"""A photograph's camera, and its lens: one whose distortion cannot be undone is refused before anything is trained."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from ctm_plugin.errors import DataError
from ctm_plugin.rays.cameras import distort, distortion_slopes, undistort
from ctm_plugin.settings.check import Number

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


class Camera(NamedTuple):
    """What took a photograph, in pixels of the picture as it was taken.

    Attributes:
        width, height: of the picture.
        fx, fy, cx, cy: focal lengths and principal point, the first pixel's centre at 0.5.
        distortion: (k1, k2, p1, p2, k3), see :func:`ctm_plugin.rays.cameras.distort`.
        where: its place in the file that says so, for messages.
    """

    width: float
    height: float
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = PINHOLE
    where: str = "a camera"

    def of_size(self, width: int, height: int, source: Path) -> tuple[float, float, float, float]:
        """(fx, fy, cx, cy) of the picture shrunk to another size.

        Raises:
            DataError: ``source`` gives a size of another ratio.
        """
        if abs(width / self.width * self.height / height - 1) > 0.02:
            found = f"{self.where} with pictures of {self.width:g}x{self.height:g}"
            raise DataError(source, found, f"the ratio of the pictures that are there, {width}x{height}")
        across, down = width / self.width, height / self.height
        return self.fx * across, self.fy * down, self.cx * across, self.cy * down
