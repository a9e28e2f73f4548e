"""Matches against places: what two cameras can both see, and what they cannot."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctm_plugin.cameras.trust import MAX_ERROR, explained

FOCAL = (300.0, 150.0)


def scene() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Two cameras ``[3, 4]``, world to camera, and the rays ``[40, 3]`` on which each sees the same points."""
    chance = np.random.default_rng(0)
    points = chance.uniform((-2, -2, 4), (2, 2, 9), (40, 3))
    turns = Rotation.from_rotvec([[0.1, 0.2, 0], [-0.2, 0.1, 0.3]]).as_matrix()
    poses = [np.column_stack([turn, move]) for turn, move in zip(turns, [(0.5, 0, 1), (-0.5, 0.3, 1)], strict=True)]
    seen = [points @ pose[:, :3].T + pose[:, 3] for pose in poses]
    return poses, [each / each[:, 2:] for each in seen]


def test_what_both_see_is_explained():
    poses, (here, there) = scene()
    assert explained(here, there, *poses, *FOCAL).all()


@pytest.mark.parametrize(("pixels", "expected"), [(0.9, True), (1.1, False)])
@pytest.mark.parametrize("side", [0, 1])
def test_pixels_are_those_of_the_picture(pixels, expected, side):
    """A place beside its line by so many bounds; all the way in one picture, so that Sampson's share of it is known."""
    poses, rays = scene()
    turn = poses[1][:, :3] @ poses[0][:, :3].T
    x, y, z = poses[1][:, 3] - turn @ poses[0][:, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ turn
    lines = (rays[0] @ essential.T)[:, :2], (rays[1] @ essential)[:, :2]  # in the second picture and in the first
    slopes = [(line**2).sum(1) / focal**2 for line, focal in zip(lines, FOCAL[::-1], strict=True)]
    own = 1 - side  # the line of the picture whose places are moved
    across = lines[own] / np.linalg.norm(lines[own], axis=1, keepdims=True)
    away = pixels * MAX_ERROR * np.sqrt((slopes[0] + slopes[1]) / slopes[own])
    rays[side][:, :2] += across * away[:, None] / FOCAL[side]
    fit = explained(*rays, *poses, *FOCAL)
    assert fit.mean() > 0.9 if expected else fit.mean() < 0.1


def test_a_camera_elsewhere_explains_little():
    poses, (here, there) = scene()
    poses[1][:, 3] += (0.0, 1.5, 0.0)
    assert explained(here, there, *poses, *FOCAL).mean() < 0.3
