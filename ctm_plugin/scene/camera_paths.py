"""Camera paths through a scene: out of the cameras that took it, or through those that a person chose."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline
from torch import Tensor

from ctm_plugin.scene.poses import facing, looked_at, mean_pose
from ctm_plugin.scene.views import Views
from ctm_plugin.settings.setting import Number

SPIRAL_PERCENTILE = 90
"""Percentile of the cameras' distances from the mean camera: the spiral's radius."""
FOCUS_SHARE, FOCUS_FAR = 0.75, 5.0
"""The focus lies at this share of the way, in disparity, from the nearest depth to ``FOCUS_FAR`` times the farthest."""
MAX_DETOUR = 1.5
"""Cameras keep their order of capture if the path through them is at most this much longer than from each to the
nearest left."""
SMOOTHING = 0.1
"""Standard deviation of the Gaussian weights that smooth a path, as a share of its length."""
DEPTH_CYCLES = 0.5
"""Oscillations of a spiral along the viewing axis in one turn."""
LIGHT_KEYS = ("light", "contrast", "saturation")
"""Keys of the light in which a path was made, as on the command line."""
EASE = 0.15
"""Share of the time in which a path's speed rises from 0, and in which it falls to 0 again."""


def focus(near: Number, far: Number) -> float:
    """Depth of the point that a spiral's cameras look at: ``1 / (0.25 / near + 0.75 / (5 far))`` (NeRF's).

    Args:
        near, far: distances that hold what the views see, > 0.
    """
    return 1.0 / ((1.0 - FOCUS_SHARE) / near + FOCUS_SHARE / (FOCUS_FAR * far))


def spiral(views: Views, near: Number, far: Number, frames: int = 120, turns: int = 2) -> Float32[Tensor, "f 3 4"]:
    """LLFF's and NeRF's path for forward-facing scenes: round the mean camera, forth and back, the eye on one point.

    In the mean camera's frame frame i stands at ``(r_x cos a, -r_y sin a, -r_z sin(a / 2))``, ``a = 2 pi turns i / F``,
    and looks at ``(0, 0, -focus)`` with the mean camera's up; r holds the 90th percentiles of the cameras' distances
    from the mean camera along its axes. An even number of turns closes the path.

    Args:
        views: whose cameras all look roughly the same way.
        near, far: see :func:`focus`.
        frames: F >= 1.
        turns: times round.

    Returns:
        ``[F, 3, 4]`` camera to world, OpenGL axes; so do the other paths.
    """
    c2w = views.c2w.cpu().double().numpy()
    mean = mean_pose(c2w)
    axes, eye = mean[:, :3], mean[:, 3]
    radii = np.percentile(np.abs((c2w[:, :, 3] - eye) @ axes), SPIRAL_PERCENTILE, axis=0)
    angle = 2.0 * np.pi * turns * np.arange(frames) / frames
    place = np.stack([np.cos(angle), -np.sin(angle), -np.sin(DEPTH_CYCLES * angle)], axis=1) * radii
    back = place - np.array([0.0, 0.0, -focus(near, far)])
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    poses = axes @ facing(back, [0.0, 1.0, 0.0], place)
    poses[:, :, 3] += eye
    return torch.from_numpy(poses).to(torch.float32)


def visiting_order(centres: Float64[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    """The order in which a path visits cameras: of capture, or always to the nearest unvisited where far shorter."""
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1)
    order = [int(apart.sum(1).argmax())]
    while len(order) < len(centres):
        left = apart[order[-1]].copy()
        left[order] = np.inf
        order.append(int(left.argmin()))
    steps = apart[np.arange(len(centres) - 1), np.arange(1, len(centres))].sum()
    own = steps <= MAX_DETOUR * apart[order[:-1], order[1:]].sum()
    return np.arange(len(centres)) if own else np.array(order)


def capture(views: Views, frames: int = 120) -> Float32[Tensor, "f 3 4"]:
    """Path that passes smoothly by the places where the photographs were taken, slowly at both ends.

    At a share s of the line through all cameras (:func:`visiting_order`) stands their mean, each camera weighed by
    ``exp(-(s - s_i)^2 / (2 0.1^2))``; so the path stays among the cameras. It is walked through as :func:`eased` says.

    Args:
        views: whose cameras stand near to their neighbours.
        frames: see :func:`spiral`.
    """
    c2w = views.c2w.cpu().double().numpy()
    c2w = c2w[visiting_order(c2w[:, :, 3])]
    along = _lengths(c2w[:, :, 3])
    fine = np.linspace(0.0, 1.0, 8 * max(frames, 16))
    places = np.interp(eased(np.linspace(0.0, 1.0, frames)), _lengths(_means(c2w, along, fine)[:, :, 3]), fine)
    mean = _means(c2w, along, places)
    back = mean[:, :, 2] / np.linalg.norm(mean[:, :, 2], axis=1, keepdims=True)
    return torch.from_numpy(facing(back, mean[:, :, 1], mean[:, :, 3])).to(torch.float32)


def eased(times: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Share of a path that is done at times in [0, 1]: the speed rises evenly over :data:`EASE`, stays, and falls.

    With e = EASE, ``s(t) = t^2 / (2 e (1 - e))`` up to e, ``(t - e / 2) / (1 - e)`` in the middle, ``1 - s(1 - t)`` at
    the end.
    """
    ends = np.minimum(times, 1.0 - times)
    half = np.where(ends < EASE, ends**2 / (2.0 * EASE), ends - EASE / 2.0) / (1.0 - EASE)
    return np.where(times < 0.5, half, 1.0 - half)


def _lengths(centres: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
    """Arc length of each point along the polyline through them, from 0 to 1; evenly where all are at one place."""
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    whole = steps.sum()
    return np.linspace(0.0, 1.0, len(centres)) if whole == 0 else np.append(0.0, steps.cumsum()) / whole


def _means(c2w: np.ndarray, along: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Means of camera matrices, ``[P, 3, 4]``, weighed by their nearness along the path to each of P places."""
    weights = np.exp(-0.5 * ((places[:, None] - along) / SMOOTHING) ** 2)
    return np.einsum("pn,nij->pij", weights / weights.sum(1, keepdims=True), c2w)


def mean_up(views: Views) -> Float64[np.ndarray, " 3"]:
    """The mean of the cameras' up directions, of unit length."""
    up = views.c2w.cpu().double().numpy()[:, :, 1].mean(0)
    return up / np.linalg.norm(up)


def orbit(views: Views, frames: int = 120) -> Float32[Tensor, "f 3 4"]:
    """Circle round what all cameras look at, at their mean height above it and their mean distance from its axis.

    Its centre is :func:`looked_at`, its axis :func:`mean_up`; it begins in the first camera's direction and turns
    anticlockwise, seen from above.

    Args:
        views: whose cameras look at one thing from around it.
        frames: see :func:`spiral`.
    """
    c2w = views.c2w.cpu().double().numpy()
    eyes = c2w[:, :, 3]
    centre, up = looked_at(c2w, damping=1e-9), mean_up(views)
    height = (eyes - centre) @ up
    flat = eyes - centre - height[:, None] * up
    radius = np.linalg.norm(flat, axis=1).mean()
    first = flat[np.linalg.norm(flat, axis=1).argmax()] if not flat[0].any() else flat[0]
    first /= np.linalg.norm(first)
    angle = 2.0 * np.pi * np.arange(frames)[:, None] / frames
    place = radius * (np.cos(angle) * first + np.sin(angle) * np.cross(up, first)) + height.mean() * up
    back = place / np.linalg.norm(place, axis=1, keepdims=True)
    return torch.from_numpy(facing(back, up, centre + place)).to(torch.float32)


@dataclass(frozen=True, eq=False)
class KeyFrames:
    """N cameras of a path, equally far apart in time.

    Attributes:
        c2w: ``[N, 3, 4]`` camera to world, OpenGL axes.
        fov: ``[N]`` vertical fields of view in radians.
        closed: whether the path goes on from the last to the first.
        lit: light in which the path was made: stops, contrast, saturation; ``None`` where that is not known.
    """

    c2w: Float64[np.ndarray, "n 3 4"]
    fov: Float64[np.ndarray, " n"]
    closed: bool = False
    lit: tuple[float, float, float] | None = None

    def path(self, frames: int) -> tuple[Float32[Tensor, "f 3 4"], Float32[Tensor, " f"]]:
        """A smooth path through all key frames.

        Centres lie on a uniform Catmull-Rom spline: between keys a cubic whose slope at key i is
        ``(p[i+1] - p[i-1]) / 2``, at an open end the difference to the only neighbour (Catmull and Rom 1974). Turns are
        scipy's cubic spline of rotations, which is slerp between two; fields of view are monotone between keys.

        Args:
            frames: F >= 1, evenly in time; an open path's last is the last key, a closed one's comes before the first.

        Returns:
            ``[F, 3, 4]`` camera to world, OpenGL axes, and ``[F]`` fields of view in radians.
        """
        c2w, fov = self.c2w, self.fov
        if len(c2w) == 1:
            return torch.from_numpy(c2w).float().expand(frames, 3, 4), torch.from_numpy(fov).float().expand(frames)
        if self.closed:
            c2w, fov = np.concatenate([c2w, c2w[:1]]), np.append(fov, fov[0])
        keys, eyes = np.arange(len(c2w)), c2w[:, :, 3]
        slopes = np.gradient(eyes, axis=0)
        if self.closed:
            slopes[0] = slopes[-1] = (eyes[1] - eyes[-2]) / 2
        at = np.linspace(0, keys[-1], frames, endpoint=not self.closed)
        rotations = RotationSpline(keys, Rotation.from_matrix(c2w[:, :, :3]))(at).as_matrix()
        poses = np.concatenate([rotations, CubicHermiteSpline(keys, eyes, slopes)(at)[:, :, None]], axis=2)
        return torch.from_numpy(poses).float(), torch.from_numpy(PchipInterpolator(keys, fov)(at)).float()

    def content(self) -> dict[str, Any]:
        """Content of a key-frame file, as :func:`ctm_plugin.data.readers.camera_path.read_key_frames` reads it."""
        keys = [
            {"camera_to_world": pose.tolist(), "fov": math.degrees(fov)}
            for pose, fov in zip(self.c2w, self.fov, strict=True)
        ]
        lit = {} if self.lit is None else dict(zip(LIGHT_KEYS, self.lit, strict=True))
        return {"closed": self.closed, **lit, "keys": keys}
