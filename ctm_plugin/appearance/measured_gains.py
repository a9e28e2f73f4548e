"""Exposure gains of a scene's training pictures, measured on points that several of them see."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float32, Float64, Int64
from scipy.sparse import coo_array
from torch import Tensor

from ctm_plugin.color.light import LUMINANCE
from ctm_plugin.color.srgb import srgb_to_linear
from ctm_plugin.scene.frustum import projected
from ctm_plugin.scene.views import Scene, unit

UNEVEN = 0.05
"""Standard deviation of gains, as a share of the light, above which pictures are uneven. Measured: 0.058 in LOM's buu,
whose lit views gain 0.5 dB by ``appearance=exposure``, and 0.047 in its bike, whose lit views lose as much."""
SIZE = 300
"""Longest side of the copies in which light is looked up, about: a pixel there is the mean of many."""
DARKEST, BRIGHTEST = 1e-5, 0.8
"""Range of linear light that is measured: neither black nor clipped."""
MIN_POINTS = 20
"""Least number of points from which a picture's gain is measured."""
ROUNDS = 20


def gains_by_points(scene: Scene) -> Float32[Tensor, " n"] | None:
    """Natural logarithms of the training pictures' gains, up to one common offset; NaN: a picture sees too few points.

    ``None``: the scene has no points, or it is unknown which pictures see them.
    """
    views, seen = scene.train, scene.points
    if seen is None:
        return None
    levels = torch.zeros(len(seen.point))
    for view, image in enumerate(views.images):
        own = seen.view == view
        at = projected(seen.positions[seen.point[own]], views, view)
        light = srgb_to_linear(unit(image[..., :3])) @ torch.tensor(LUMINANCE)
        light = light if views.mask is None else light.where(views.mask[view], torch.nan)
        size = max(1, max(light.shape) // SIZE)
        small = F.avg_pool2d(light[None, None], size)
        places = torch.stack([at.column / small.shape[3], at.row / small.shape[2]], -1) * (2 / size) - 1
        looked_up = F.grid_sample(small, places[None, None], align_corners=False)[0, 0, 0]
        levels[own] = looked_up.where(at.seen, torch.nan)
    told = (levels > DARKEST) & (levels < BRIGHTEST)
    parts = (levels[told].double().log(), seen.view[told], seen.point[told])
    gains = torch.from_numpy(log_gains(*(each.numpy() for each in parts), len(views))).float()
    return None if gains.isnan().all() else gains


def log_gains(
    levels: Float64[np.ndarray, " o"], views: Int64[np.ndarray, " o"], points: Int64[np.ndarray, " o"], count: int
) -> Float64[np.ndarray, " v"]:
    """Natural logarithms of ``count`` views' gains, up to one common offset, out of logarithms of light.

    ``levels = gain of the view + light of the point``, by least squares with Cauchy's weights ``1 / (1 + (r / 2s)^2)``
    of residuals r, s their spread. NaN: a view with fewer than :data:`MIN_POINTS` points.
    """
    _, points = np.unique(points, return_inverse=True)
    gains, weights = np.zeros(count), np.ones(len(levels))
    for _ in range(ROUNDS if len(levels) else 0):
        seen = coo_array((weights, (points, views)), (points.max() + 1, count)).tocsr()
        sums = np.bincount(points, weights)
        lights = np.bincount(points, weights * levels) / sums
        normal = np.diag(np.bincount(views, weights, count)) - (seen.T @ seen.multiply(1 / sums[:, None])).toarray()
        gains = np.linalg.lstsq(normal, np.bincount(views, weights * levels, count) - seen.T @ lights, rcond=1e-9)[0]
        rest = levels - gains[views]
        rest -= (np.bincount(points, weights * rest) / sums)[points]
        weights = 1 / (1 + (rest / (2 * 1.4826 * np.median(np.abs(rest)) + 1e-9)) ** 2)
    return np.where(np.bincount(views, minlength=count) < MIN_POINTS, np.nan, gains)
