"""A path through key frames against closed forms."""

import math

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from ctm_plugin.scene.key_frames import KeyFrames


def some(count: int, closed: bool = False) -> KeyFrames:
    rng = np.random.default_rng(count)
    turns = Rotation.from_rotvec(rng.uniform(-1, 1, (count, 3))).as_matrix()
    poses = np.concatenate([turns, rng.uniform(-3, 3, (count, 3, 1))], axis=2)
    return KeyFrames(poses, rng.uniform(0.3, 1.5, count), closed)


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("closed", [False, True])
def test_it_goes_through_all_keys(count, closed):
    keys = some(count, closed)
    c2w, fov = keys.path(4 * count if closed else 4 * (count - 1) + 1)
    np.testing.assert_allclose(c2w[::4], keys.c2w, atol=1e-6)
    np.testing.assert_allclose(fov[::4], keys.fov, atol=1e-6)
    turns = c2w[:, :, :3].double().numpy()
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-6)


def test_between_two_it_is_straight_and_turns_evenly():
    keys = some(2)
    c2w, _ = keys.path(5)
    share = np.linspace(0, 1, 5)
    straight = keys.c2w[0, :, 3] + share[:, None] * (keys.c2w[1, :, 3] - keys.c2w[0, :, 3])
    np.testing.assert_allclose(c2w[:, :, 3], straight, atol=1e-6)
    turns = Slerp([0, 1], Rotation.from_matrix(keys.c2w[:, :, :3]))(share).as_matrix()
    np.testing.assert_allclose(c2w[:, :, :3], turns, atol=1e-6)


def test_centres_are_catmull_and_roms():
    """Half way between p1 and p2: ``(-p0 + 9 p1 + 9 p2 - p3) / 16``."""
    keys = some(4)
    p = keys.c2w[:, :, 3]
    c2w, _ = keys.path(7)
    np.testing.assert_allclose(c2w[3, :, 3], (-p[0] + 9 * p[1] + 9 * p[2] - p[3]) / 16, atol=1e-6)


def test_a_closed_path_is_as_smooth_at_its_end():
    """Round a square at even steps it is the same from each corner, a quarter turn further."""
    angles = np.arange(4) * math.pi / 2
    turns = Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    eyes = np.stack([np.cos(angles), np.sin(angles), np.zeros(4)], axis=1)
    c2w, _ = KeyFrames(np.concatenate([turns, eyes[:, :, None]], axis=2), np.ones(4), closed=True).path(40)
    centres = c2w[:, :, 3].double().numpy()
    quarter = turns[1]
    np.testing.assert_allclose(centres[10:20], centres[:10] @ quarter.T, atol=1e-6)
    np.testing.assert_allclose(centres[30:], centres[20:30] @ quarter.T, atol=1e-6)


def test_fields_of_view_stay_between_the_keys():
    keys = KeyFrames(some(4).c2w, np.array([0.2, 0.2, 3.0, 3.0]))
    _, fov = keys.path(100)
    assert fov.min() >= np.float32(0.2)
    assert fov.max() <= np.float32(3.0)
    assert CubicHermiteSpline(range(4), keys.fov, np.gradient(keys.fov))(np.linspace(0, 3, 100)).max() > 3  # not so
