"""Camera paths through a scene, out of the cameras that took it: for videos."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from ctm_plugin.scene.poses import mean_pose
from ctm_plugin.scene.views import Views
from ctm_plugin.settings.check import Number

QUANTILE = 90
"""Of the cameras' distances from the mean camera: how far out the spiral goes."""
DEEPER, FARTHER = 0.75, 5.0
"""The focus lies at this part of the way from the nearest to ``FARTHER`` times the farthest, in disparity."""
DEPTH_TURNS = 0.5
"""Times forth and back in a turn round."""


def focus(near: Number, far: Number) -> float:
    """Depth of the point that a spiral's cameras look at: ``1 / (0.25 / near + 0.75 / (5 far))`` (NeRF's).

    Args:
        near, far: distances that hold what the views see, > 0.
    """
    return 1.0 / ((1.0 - DEEPER) / near + DEEPER / (FARTHER * far))


def spiral(views: Views, near: Number, far: Number, frames: int = 120, turns: int = 2) -> Float32[Tensor, "f 3 4"]:
    """LLFF's and NeRF's path for forward-facing scenes: round the mean camera, forth and back, the eye on one point.

    In the mean camera's frame frame i stands at ``(r_x cos a, -r_y sin a, -r_z sin(a / 2))``, ``a = 2 pi turns i / F``,
    and looks at ``(0, 0, -focus)`` with the mean camera's up; r holds the 90th percentiles of the cameras' distances
    from the mean camera along its axes. An even number of turns closes the path.

    Args:
        views: whose cameras all look roughly the same way.
        near, far: distances that hold what they see, > 0, see :func:`focus`.
        frames: F >= 1.
        turns: times round.

    Returns:
        ``[F, 3, 4]`` camera to world, OpenGL axes.
    """
    c2w = views.c2w.cpu().double().numpy()
    mean = mean_pose(c2w)
    axes, eye = mean[:, :3], mean[:, 3]
    radii = np.percentile(np.abs((c2w[:, :, 3] - eye) @ axes), QUANTILE, axis=0)
    angle = 2.0 * np.pi * turns * np.arange(frames) / frames
    place = np.stack([np.cos(angle), -np.sin(angle), -np.sin(DEPTH_TURNS * angle)], axis=1) * radii
    back = place - np.array([0.0, 0.0, -focus(near, far)])
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    local = np.stack([right, np.cross(back, right), back, place], axis=2)
    poses = axes @ local
    poses[:, :, 3] += eye
    return torch.from_numpy(poses).to(torch.float32)


def looked_at(views: Views) -> Float64[np.ndarray, " 3"]:
    """The point nearest to all optical axes (least squares): what cameras around a thing look at."""
    c2w = views.c2w.cpu().double().numpy()
    eyes, axes = c2w[:, :, 3], -c2w[:, :, 2]
    # Of a point p, the part of p - eye across an axis: (1 - a a^T)(p - eye). Tikhonov's term for parallel axes.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    return np.linalg.solve(across.sum(0) + 1e-9 * np.eye(3), np.einsum("nij,nj->i", across, eyes))


def mean_up(views: Views) -> Float64[np.ndarray, " 3"]:
    """The mean of the cameras' up directions, of unit length."""
    up = views.c2w.cpu().double().numpy()[:, :, 1].mean(0)
    return up / np.linalg.norm(up)


def orbit(views: Views, frames: int = 120) -> Float32[Tensor, "f 3 4"]:
    """Once round what all cameras look at, at their mean height above it and their mean distance from its axis.

    The path is round :func:`looked_at` and :func:`mean_up`; it begins in the first camera's direction and turns
    anticlockwise, seen from above.

    Args:
        views: whose cameras look at one thing from around it.
        frames: F >= 1.

    Returns:
        ``[F, 3, 4]`` camera to world, OpenGL axes.
    """
    eyes = views.c2w.cpu().double().numpy()[:, :, 3]
    centre, up = looked_at(views), mean_up(views)
    height = (eyes - centre) @ up
    flat = eyes - centre - height[:, None] * up
    radius = np.linalg.norm(flat, axis=1).mean()
    first = flat[np.linalg.norm(flat, axis=1).argmax()] if not flat[0].any() else flat[0]
    first /= np.linalg.norm(first)
    angle = 2.0 * np.pi * np.arange(frames)[:, None] / frames
    place = radius * (np.cos(angle) * first + np.sin(angle) * np.cross(up, first)) + height.mean() * up
    back = place / np.linalg.norm(place, axis=1, keepdims=True)
    right = np.cross(up, back)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.stack([right, np.cross(back, right), back, centre + place], axis=2)
    return torch.from_numpy(poses).to(torch.float32)
