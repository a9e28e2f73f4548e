"""Checks of a COLMAP model: agreement of its poses with the matches, and number of observations."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from ctm_plugin.cameras.colmap import Reconstruction, count_observations, require_pycolmap

MAX_ERROR = 4.0
"""Largest distance in pixels between a match and its epipolar line; COLMAP's own bound for two pictures."""
MIN_INLIERS = 0.7
"""Least share of a picture's matches that its camera must explain. Measured: 0.81 and more where cameras are right,
0.54 and less where one is off by a third of the extent."""


class Trusted(NamedTuple):
    """A checked model, without the pictures whose poses contradict their matches.

    Attributes:
        model: COLMAP's model; ``None``: no picture got a pose.
        placed: number of pictures in the model.
        taken_out: number of pictures removed from it.
        observations: see :func:`~ctm_plugin.cameras.colmap.count_observations`.
    """

    model: Reconstruction | None = None
    placed: int = 0
    taken_out: int = 0
    observations: int = 0

    @property
    def mean(self) -> float:
        """Mean number of :func:`count_observations` a picture."""
        return self.observations / max(self.placed, 1)


def trusted(model: Reconstruction | None, database: Path) -> Trusted:
    """Remove pictures whose poses contradict the matches in ``database``, and count the rest's observations."""
    if model is None:
        return Trusted()
    wrong = [number for number, share in shares(model, database).items() if share < MIN_INLIERS]
    for number in wrong:
        model.deregister_frame(model.image(number).frame_id)
    return Trusted(model, model.num_reg_images(), len(wrong), count_observations(model))


def shares(model: Reconstruction, database: Path) -> dict[int, float]:
    """Share of each picture's matches with other posed pictures that its pose explains, by picture number."""
    colmap = require_pycolmap()
    stored = colmap.Database.open(database)
    matches = zip(*stored.read_two_view_geometries(), strict=True)
    rays = {number: _rays(model, number, stored.read_keypoints(number)) for number in model.reg_image_ids()}
    stored.close()
    good, count = Counter(), Counter(dict.fromkeys(rays, 0))
    for pair, geometry in matches:
        first, second = colmap.pair_id_to_image_pair(pair)
        if not (first in rays and second in rays and len(geometry.inlier_matches)):
            continue
        here, there = np.asarray(geometry.inlier_matches).T
        poses = [model.image(number).cam_from_world().matrix() for number in (first, second)]
        focal = [model.image(number).camera.mean_focal_length() for number in (first, second)]
        fit = explained(rays[first][here], rays[second][there], *poses, *focal)
        for number in (first, second):
            good[number] += int(fit.sum())
            count[number] += len(fit)
    return {number: good[number] / max(count[number], 1) for number in rays}


def _rays(model: Reconstruction, number: int, places: Any) -> Float64[np.ndarray, "n 3"]:
    seen = model.image(number).camera.cam_from_img(places[:, :2].astype(np.float64))
    return np.concatenate([seen, np.ones((len(seen), 1))], axis=1)


def explained(
    here: Float64[np.ndarray, "n 3"], there: Float64[np.ndarray, "n 3"],
    pose: Float64[np.ndarray, "3 4"], other: Float64[np.ndarray, "3 4"],
    focal: float, other_focal: float,
) -> Bool[np.ndarray, " n"]:  # fmt: skip
    """Whether two cameras may see the same points on rays ``[N, 3]`` (x, y, 1), in their own axes.

    Sampson's distance to the epipolar lines is at most :data:`MAX_ERROR` pixels (Hartley and Zisserman, Multiple View
    Geometry, 11.4.3). Poses ``[3, 4]`` are from world to camera, focal lengths in pixels.
    """
    turn = other[:, :3] @ pose[:, :3].T
    x, y, z = other[:, 3] - turn @ pose[:, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ turn
    line, back = here @ essential.T, there @ essential
    slope = (line[:, :2] ** 2).sum(1) / other_focal**2 + (back[:, :2] ** 2).sum(1) / focal**2
    return (there * line).sum(1) ** 2 <= MAX_ERROR**2 * slope
