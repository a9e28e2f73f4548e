"""A photograph's camera, and its lens: one whose distortion cannot be undone is refused before anything is trained."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch

from ctm_plugin.errors import DataError
from ctm_plugin.rays.cameras import distort, distortion_slopes, undistort

PINHOLE = (0.0, 0.0, 0.0, 0.0, 0.0)
"""(k1, k2, p1, p2, k3) of a lens without distortion."""
GRID_POINTS = 49
"""Points along a side of the grid on which a lens is tested."""
UNDISTORT_TOLERANCE = 1e-6
"""Largest error of the inverse, in focal lengths: a hundredth of a pixel at a focal length of 10,000."""
MIN_DETERMINANT = 1e-3
"""Least factor by which a lens may shrink a small area: near zero it folds."""
CROP_RATIOS = (0.8, 1.25)
"""Range of scales in which a picture of another size may be cropped instead of scaled."""


def check_lens(camera: Intrinsics, source: Path) -> None:
    """Refuse a lens of ``source`` that does not map one to one inside the image: its pixels have no rays.

    A grid of :data:`GRID_POINTS` image points a side, edges included, must be undone to :data:`UNDISTORT_TOLERANCE`.
    Between the axis and each of their sources, at eight places, the determinant of the mapping's derivative must stay
    positive.
    """
    lens = torch.tensor(camera.distortion, dtype=torch.float64)
    across, down = (torch.linspace(0, side, GRID_POINTS, dtype=torch.float64) for side in (camera.width, camera.height))
    x = ((across - camera.cx) / camera.fx).repeat(GRID_POINTS)
    y = ((down - camera.cy) / camera.fy).repeat_interleave(GRID_POINTS)
    u, v = undistort(x, y, lens)
    back_x, back_y = distort(u, v, lens)
    off = torch.maximum((back_x - x).abs(), (back_y - y).abs()).max()
    part = torch.linspace(0, 1, 9, dtype=torch.float64)[:, None]
    xx, xy, yy = distortion_slopes(part * u, part * v, lens)
    # Comparisons that NaN fails.
    if not (off <= UNDISTORT_TOLERANCE and (xx * yy - xy * xy >= MIN_DETERMINANT).all()):
        numbers = ", ".join(f"{value:g}" for value in camera.distortion)
        found = f"{camera.where} with distortion (k1, k2, p1, p2, k3) = ({numbers})"
        raise DataError(source, found, "a lens that maps one to one inside the image")


class Intrinsics(NamedTuple):
    """Intrinsics and distortion of a photograph's camera, in pixels of the picture as it was taken.

    Attributes:
        width, height: size of the picture.
        fx, fy, cx, cy: focal lengths and principal point, the first pixel's centre at 0.5.
        distortion: (k1, k2, p1, p2, k3), see :func:`ctm_plugin.rays.cameras.distort`.
        where: the intrinsics' place in their file, for messages.
    """

    width: float
    height: float
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = PINHOLE
    where: str = "a camera"

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """Focal lengths and principal point (fx, fy, cx, cy) in pixels."""
        return self.fx, self.fy, self.cx, self.cy

    def scaled(self, width: int, height: int) -> Intrinsics:
        """Intrinsics of the same picture in another size; x and y are scaled separately."""
        across, down = width / self.width, height / self.height
        return self._replace(
            width=width, height=height, fx=self.fx * across, fy=self.fy * down, cx=self.cx * across, cy=self.cy * down
        )

    def of_picture(
        self, width: int, height: int, path: Path, source: Path, crop: tuple[int, ...] | None = None
    ) -> Intrinsics:
        """Intrinsics of a picture that may have another size than ``source`` says.

        The same picture at another scale is recognised by its ratio; at nearly the same scale it may be cut
        instead, as ``crop`` says: (left, top) pixels cut off; empty: none were; ``None``: unknown.
        """
        found = f"a picture of {width}x{height}"
        frame = f"{self.width:g}x{self.height:g} as {self.where} of {source.name}"
        if crop:
            left, top = crop
            if left + width > self.width or top + height > self.height:
                raise DataError(path, found, f"one that lies within {frame} with dataset.crop=[{left},{top}]")
            return self._replace(width=width, height=height, cx=self.cx - left, cy=self.cy - top)
        if (width, height) == (self.width, self.height):
            return self
        ratio = width / self.width
        off = abs(self.height * ratio - height)
        alike = min(off, off / self.height * self.width) <= 1
        if alike and (crop is not None or not CROP_RATIOS[0] < ratio < CROP_RATIOS[1]):
            return self.scaled(width, height)
        either = "dataset.crop=[] if it was scaled, " if alike else "the same at another scale, or "
        raise DataError(path, found, f"{frame}: {either}dataset.crop=[LEFT,TOP] if it was cut, of pixels cut off there")
