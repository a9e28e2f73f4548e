"""Arrangement of a capture's cameras, which decides the geometry and a film's path; no pixels are read."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from ctm_plugin.data.readers.lens import Intrinsics
from ctm_plugin.scene.kinds import GEOMETRIES, Geometry
from ctm_plugin.scene.poses import meeting_depths, meeting_point

MAX_NDC_ANGLE = math.radians(80)
"""Largest angle in radians between the mean axis and a ray at which NDC's planes still resolve the picture's edge."""
MAX_ADVANCE = 0.7
"""Largest distance of a camera in front of the mean one, as a share of the nearest depth: NDC's near plane lies at
0.75."""
ASSUMED_NEAR = 0.4
"""Nearest depth where none is known, as a share of the depth at which the axes meet."""
SURROUND_DEGREES = 270.0
"""Degrees that cameras cover from which they go round an object."""


@dataclass(frozen=True)
class Rig:
    """The cameras of a capture.

    Attributes:
        c2w: ``[N, 3, 4]`` camera to world, OpenGL axes.
        corner: the largest angle between a camera's axis and a ray of its picture, in radians.
        size: height and width of a training picture.
        alone: whether there is an object with nothing behind it, as where pictures have alpha.
        near: nearest depth by the files or their points; ``None``: unknown.
    """

    c2w: Float64[np.ndarray, "n 3 4"]
    corner: float
    size: tuple[int, int]
    alone: bool
    near: float | None = None

    @property
    def angle(self) -> float:
        """The largest angle between an axis and the mean one, in radians; pi where axes cancel out."""
        axes = -self.c2w[:, :, 2]
        mean = axes.sum(0)
        length = np.linalg.norm(mean)
        return math.pi if length < 1e-6 * len(axes) else float(np.arccos((axes @ mean / length).clip(-1, 1)).max())

    @property
    def looks_one_way(self) -> bool:
        """Whether NDC suits: all rays go the same way, from cameras at nearly the same depth."""
        if self.angle + self.corner >= MAX_NDC_ANGLE:
            return False
        mean = -self.c2w[:, :, 2].sum(0)
        along = self.c2w[:, :, 3] @ mean / np.linalg.norm(mean)
        near = self.near
        if near is None:
            depths = meeting_depths(self.c2w)
            spread = np.linalg.norm(self.c2w[:, :, 3] - self.c2w[:, :, 3].mean(0), axis=1).max()
            near = ASSUMED_NEAR * float(spread if depths is None else depths.min())
        return bool(along.max() - along.mean() <= MAX_ADVANCE * near)

    def geometry(self, among: Sequence[str] = GEOMETRIES) -> tuple[Geometry, str]:
        """Choose the geometry, ``among`` those that a backbone has, and give the reason in words."""
        if self.looks_one_way and not self.alone:
            return "forward", f"all {len(self.c2w)} cameras look one way, within {math.degrees(self.angle):.0f} degrees"
        around = turn(self.c2w)
        why = f"the cameras go round {around:.0f} degrees" if around else "the cameras look different ways"
        return "bounded" if self.alone or self.near == 0 or "unbounded" not in among else "unbounded", why


def rig_of(
    cameras: Iterable[Intrinsics],
    poses: Sequence[Float64[np.ndarray, "3 4"]],
    size: tuple[int, int],
    alone: bool,
    near: float | None = None,
) -> Rig:
    """Make the rig of these cameras, lens distortion ignored."""
    corner = max(
        math.hypot(max(each.cx, each.width - each.cx) / each.fx, max(each.cy, each.height - each.cy) / each.fy)
        for each in cameras
    )
    return Rig(np.stack(poses), math.atan(corner), size, alone, near)


def turn(c2w: Float64[np.ndarray, "n 3 4"]) -> float:
    """Degrees that cameras go round the point where their axes meet, seen along their mean up; 0 where none meet."""
    point = meeting_point(c2w)
    up = c2w[:, :, 1].sum(0)
    if point is None or (length := np.linalg.norm(up)) < 1e-6 * len(c2w):
        return 0.0
    across = np.linalg.svd((up / length)[None])[2][1:]  # two axes of the plane that up stands on
    x, y = across @ (c2w[:, :, 3] - point).T
    angles = np.sort(np.degrees(np.arctan2(y, x)))
    return 360.0 - float(np.diff(np.append(angles, angles[0] + 360.0)).max())
