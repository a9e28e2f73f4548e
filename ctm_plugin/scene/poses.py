"""Cameras of a data set: poses that are rigid motions, intrinsics in pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from ctm_plugin.errors import DataError
from ctm_plugin.settings.setting import Number

ROTATION_TOLERANCE = 1e-3
"""Largest entry of ``R R^T - I`` of a rotation."""
MAX_COORDINATE = 1e6
"""Largest coordinate of a pose in scene units: float32 resolves no more than 0.06 out there."""
MIN_ANGLE = 1e-4
"""Least field of view in radians, and least distance of one from pi: focal lengths stay finite."""

MIN_SINE_SQUARED = 1e-4
"""Mean squared sine of the angle between axes below which their meeting point is unknown: half a degree."""


def check_rotation(rotation: Float64[np.ndarray, "3 3"], source: Path, where: str) -> None:
    """Refuse a matrix that is not a rotation: ``|R^T R - 1| <= 0.001`` in every entry and ``det R > 0``.

    Args:
        rotation: ``[3, 3]``, finite.
        source, where: the file and the place in it, for the message.

    Raises:
        DataError: the matrix scales, shears or mirrors.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
        found = "mirrors (determinant -1)" if np.linalg.det(rotation) < 0 else ""
    if not off <= ROTATION_TOLERANCE:
        found = f"is off orthonormal by {off:.3g}"
    if found:
        expected = f"a rotation: orthonormal to {ROTATION_TOLERANCE:g}, determinant +1"
        raise DataError(source, f"{where} whose 3x3 part {found}", expected)


def check_pose(c2w: Float64[np.ndarray, "4 4"], source: Path, where: str) -> None:
    """Refuse a matrix that is not a rigid motion: a rotation, a translation, and 0 0 0 1 in the last row.

    Raises:
        DataError: see :func:`check_rotation`; or the last row is another.
    """
    check_rotation(c2w[:3, :3], source, where)
    if np.abs(c2w[3] - [0.0, 0.0, 0.0, 1.0]).max() > ROTATION_TOLERANCE:
        raise DataError(source, f"{where} whose last row is {c2w[3].tolist()}", "0 0 0 1 in the last row")


def is_field_of_view(angle: Number) -> bool:
    """Whether ``angle`` is a field of view in radians: in (0, pi) with a margin of ``MIN_ANGLE``."""
    return MIN_ANGLE <= angle <= math.pi - MIN_ANGLE


def facing(
    back: Float64[np.ndarray, "*n 3"], up: Sequence[float] | np.ndarray, eye: Float64[np.ndarray, "*n 3"]
) -> Float64[np.ndarray, "*n 3 4"]:
    """Make poses ``[..., 3, 4]`` of cameras at ``eye`` that look along -``back``, of unit length, ``up`` upwards."""
    right = np.cross(up, back)
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(back, right), back, eye], axis=-1)


def mean_pose(c2w: Float64[np.ndarray, "n 3 4"]) -> Float64[np.ndarray, "3 4"]:
    """The mean camera: the mean position, ``back`` the mean of the viewing axes, ``up`` the mean of the ups made
    orthogonal to it (LLFF's and NeRF's way).

    NaN where the axes cancel out.
    """
    back = c2w[:, :, 2].sum(0)
    with np.errstate(invalid="ignore"):
        return facing(back / np.linalg.norm(back), c2w[:, :, 1].sum(0), c2w[:, :, 3].mean(0))


class Similarity(NamedTuple):
    """Map from one world to another: ``p -> scale turn p + shift``, and how well cameras agree on it.

    Attributes:
        off: largest distance between matched cameras, as a share of the spread of all (root mean square).
        angle: largest angle between matched cameras, in radians.
    """

    scale: float
    turn: Float64[np.ndarray, "3 3"]
    shift: Float64[np.ndarray, " 3"]
    off: float
    angle: float

    def moved(self, points: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
        """Map points of the source world into the target world."""
        return self.scale * points @ self.turn.T + self.shift

    def of_poses(self, c2w: Float64[np.ndarray, "n 3 4"]) -> Float64[np.ndarray, "n 3 4"]:
        """Map cameras of the source world into the target world."""
        return np.concatenate([self.turn @ c2w[:, :, :3], self.moved(c2w[:, :, 3])[..., None]], axis=2)

    def inverse(self) -> Similarity:
        """The similarity from the target world back to the source world."""
        shift = -self.shift @ self.turn / self.scale
        return self._replace(scale=1 / self.scale, turn=self.turn.T, shift=shift)


IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3), off=0.0, angle=0.0)
"""The similarity that changes nothing."""


def similarity(source: Float64[np.ndarray, "n 3 4"], target: Float64[np.ndarray, "n 3 4"]) -> Similarity:
    """Find the similarity that takes the cameras of one world to the same cameras in another.

    The turn is the rotation nearest to the sum of ``R_target R_source^T``, so that two cameras, and centres on a line,
    are enough; scale and shift are the centres' least squares.

    Args:
        source, target: camera to world of the same cameras.

    Returns:
        Its ``off`` is infinite where the centres of either coincide or the worlds mirror one another.
    """
    u, _, v = np.linalg.svd((target[:, :, :3] @ source[:, :, :3].transpose(0, 2, 1)).sum(0))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    middle, centre = source[:, :, 3].mean(0), target[:, :, 3].mean(0)
    before, after = (source[:, :, 3] - middle) @ turn.T, target[:, :, 3] - centre
    size, spread = float((before**2).sum()), float(np.sqrt((after**2).sum(1).mean()))
    scale = float((before * after).sum()) / size if size > 0 else 0.0
    off = np.linalg.norm(after - scale * before, axis=1).max() / spread if scale > 0 and spread > 0 else math.inf
    cosine = (np.trace((turn @ source[:, :, :3]).transpose(0, 2, 1) @ target[:, :, :3], axis1=1, axis2=2) - 1) / 2
    angle = float(np.arccos(cosine.clip(-1, 1)).max())
    return Similarity(scale, turn, centre - scale * turn @ middle, float(off), angle)


def looked_at(c2w: Float64[np.ndarray, "n 3 4"], damping: float = 0.0) -> Float64[np.ndarray, " 3"]:
    """Find the point nearest to all cameras' axes by least squares, damped (Tikhonov) where these may be parallel."""
    across = np.eye(3) - c2w[:, :, 2, None] * c2w[:, None, :, 2]
    return np.linalg.solve(across.sum(0) + damping * np.eye(3), (across @ c2w[:, :, 3:]).sum(0))[:, 0]


def meeting_point(c2w: Float64[np.ndarray, "n 3 4"]) -> Float64[np.ndarray, " 3"] | None:
    """Find the point where the cameras' axes meet: nearest to all of them, by least squares.

    Returns:
        ``None`` where they do not meet in front of all cameras: they look past one another, outwards or in parallel.
    """
    forward = -c2w[:, :, 2]
    if np.linalg.eigvalsh(np.eye(3) - forward.T @ forward / len(forward))[0] < MIN_SINE_SQUARED:
        return None
    point = looked_at(c2w)
    depths = ((point - c2w[:, :, 3]) * forward).sum(1)
    return point if depths.min() > 0.1 * np.median(depths) > 0 else None


def meeting_depths(c2w: Float64[np.ndarray, "n 3 4"]) -> Float64[np.ndarray, " n"] | None:
    """Find the depth of the :func:`meeting_point` in each camera; ``None`` where there is none."""
    point = meeting_point(c2w)
    return None if point is None else ((c2w[:, :, 3] - point) * c2w[:, :, 2]).sum(1)
