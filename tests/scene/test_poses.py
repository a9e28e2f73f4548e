"""How cameras of one world lie in another, and where their axes meet."""

import math

import numpy as np
import pytest
from ctm_scenes.trajectory import forward_facing, hemisphere
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ctm_plugin.scene.poses import meeting_depths, similarity


def moved(c2w: np.ndarray, scale: float, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    return np.concatenate([turn @ c2w[:, :3, :3], scale * (turn @ c2w[:, :3, 3:]) + shift[:, None]], axis=2)


@given(
    st.floats(0.01, 100), st.integers(0, 1000), st.lists(st.floats(-50, 50), min_size=3, max_size=3), st.integers(2, 9)
)
def test_a_similarity_is_found(scale, seed, shift, count):
    """Also from two cameras, whose centres alone would leave a turn open."""
    c2w = hemisphere(count, 4.0, seed=seed)[:, :3]
    turn = Rotation.random(random_state=seed).as_matrix()
    found = similarity(c2w, moved(c2w, scale, turn, np.array(shift)))
    assert found.scale == pytest.approx(scale)
    np.testing.assert_allclose(found.turn, turn, atol=1e-9)
    np.testing.assert_allclose(found.shift, shift, atol=1e-6 * (scale + 50))
    assert found.off < 1e-9
    assert found.angle < 1e-6
    there = found.of_poses(c2w)
    np.testing.assert_allclose(there, moved(c2w, scale, turn, np.array(shift)), atol=1e-6 * (scale + 50))
    np.testing.assert_allclose(found.inverse().of_poses(there), c2w, atol=1e-6 * (1 + 50 / scale))


def test_other_cameras_are_told_from_the_same():
    c2w = hemisphere(8, 4.0, seed=1)[:, :3]
    assert similarity(c2w, hemisphere(8, 4.0, seed=2)[:, :3]).off > 0.1
    one = c2w.copy()
    one[3, :, 3] += 0.5
    assert 0.05 < similarity(c2w, one).off < 0.2
    turned = c2w.copy()
    turned[3, :, :3] = turned[3, :, :3] @ Rotation.from_euler("x", 10, degrees=True).as_matrix()
    assert similarity(c2w, turned).angle == pytest.approx(math.radians(10), rel=0.2)
    assert similarity(c2w, c2w * [1, 1, 1, 0]).off == math.inf
    assert similarity(c2w * [1, 1, 1, 0], c2w).off == math.inf


def test_axes_meet_where_all_look():
    c2w = hemisphere(12, 4.0, seed=5)[:, :3]
    np.testing.assert_allclose(meeting_depths(c2w), 4.0)
    wall = forward_facing(9, (0.0, -4.0, 0.0), (0.0, 1.0, 0.0), (0.6, 0.4), seed=1)[:, :3]
    away = np.array([0.0, 1.0, 0.0]) - wall[:, :, 3]
    np.testing.assert_allclose(meeting_depths(wall), -(away * wall[:, :, 2]).sum(1), rtol=1e-6)


def test_axes_that_do_not_meet():
    c2w = hemisphere(12, 4.0, seed=5)[:, :3]
    outwards = c2w * [-1, 1, -1, 1]  # turned about their own ups
    assert meeting_depths(outwards) is None
    parallel = np.repeat(c2w[:1], 5, axis=0)
    parallel[:, :, 3] += np.random.default_rng(0).normal(size=(5, 3))
    assert meeting_depths(parallel) is None
