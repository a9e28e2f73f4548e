"""Relative exposures of photographs of one scene, measured on points that several of them see."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, Int64

from ctm_plugin.cameras.colmap import MIN_TRACK, require_pycolmap
from ctm_plugin.cameras.photographs import MODEL_FOLDER, home_of
from ctm_plugin.cameras.refine import looked_up
from ctm_plugin.cameras.search import read_light
from ctm_plugin.cameras.settings import DEFAULT_FOLDER
from ctm_plugin.data.readers.colmap_model import is_as_shown
from ctm_plugin.data.readers.images import read_picture

UNEVEN = 0.05
"""Spread of gains above which photographs are uneven. Measured: 0.054 in LOM's buu, whose lit views gain 0.5 dB by
``appearance=exposure``, and 0.047 in its bike."""
SIZE = 300
"""Longest side of the copies in which light is looked up: a pixel there is the mean of many."""
DARKEST, BRIGHTEST = 1e-5, 0.8
"""Range of linear light that is measured: neither black nor clipped."""
MIN_POINTS = 20
"""Least number of points from which a photograph's gain is measured."""
ROUNDS = 10


def spread_of_gains(root: Path) -> float:
    """Standard deviation of the photographs' exposure gains, as a share of the light.

    It is 0 unless ``ctm cameras`` found the cameras of ``root``.
    """
    if not (is_as_shown(root / MODEL_FOLDER) and find_spec("pycolmap")):
        return 0.0
    model, home = require_pycolmap().Reconstruction(root / MODEL_FOLDER), home_of(root, DEFAULT_FOLDER)
    levels, views, points = [], [], []
    for view in model.reg_image_ids():
        image = model.image(view)
        seen = [each for each in image.points2D if each.has_point3D()]
        seen = [each for each in seen if model.points3D[each.point3D_id].track.length() >= MIN_TRACK]
        light, scale = read_light(read_picture(home / image.name), SIZE)
        places = torch.from_numpy(np.array([each.xy for each in seen], np.float32).reshape(-1, 1, 2)) / scale
        level = looked_up(light, places)[0][:, 0].double().numpy()
        told = (level > DARKEST) & (level < BRIGHTEST)
        levels.append(np.log(level[told]))
        points.append(np.array([each.point3D_id for each in seen], np.int64)[told])
        views.append(np.full(told.sum(), view))
    gains = log_gains(*map(np.concatenate, (levels, views, points)))
    return float(np.std(gains)) if len(gains) else 0.0


def log_gains(
    levels: Float64[np.ndarray, " o"], views: Int64[np.ndarray, " o"], points: Int64[np.ndarray, " o"]
) -> Float64[np.ndarray, " v"]:
    """Natural logarithms of the views' gains, up to one common offset, out of logarithms of light.

    ``levels = gain of the view + light of the point``: each in turn is the median of levels less the other. Views with
    fewer than :data:`MIN_POINTS` points are left out.
    """
    _, views, counts = np.unique(views, return_inverse=True, return_counts=True)
    _, points = np.unique(points, return_inverse=True)
    gains, lights = np.zeros(len(counts)), np.zeros(points.max(initial=-1) + 1)
    for _ in range(ROUNDS):
        lights = medians(levels - gains[views], points)
        gains = medians(levels - lights[points], views)
        gains -= gains.mean() if len(gains) else 0.0
    return gains[counts >= MIN_POINTS]


def medians(values: Float64[np.ndarray, " o"], groups: Int64[np.ndarray, " o"]) -> Float64[np.ndarray, " g"]:
    """The median of each group's values; groups are numbered from 0, none is empty."""
    order = np.lexsort((values, groups))
    counts = np.bincount(groups)
    starts = np.cumsum(counts) - counts
    values = values[order]
    return 0.5 * (values[starts + (counts - 1) // 2] + values[starts + counts // 2])
