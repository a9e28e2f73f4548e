"""Camera paths: closed forms and properties."""

import numpy as np
import pytest
from ctm_scenes.trajectory import hemisphere, look_at, on_sphere, orbit
from hypothesis import given
from hypothesis import strategies as st


def check_poses(poses: np.ndarray, radius: float) -> None:
    """Rigid matrices at ``radius`` that look at the origin and hold z upright."""
    rotation, eye = poses[:, :3, :3], poses[:, :3, 3]
    np.testing.assert_allclose(
        rotation @ rotation.transpose(0, 2, 1), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
    np.testing.assert_array_equal(poses[:, 3], np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(poses), 4)))
    np.testing.assert_allclose(eye - radius * rotation[:, :, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(rotation[:, 2, 0], 0.0, atol=1e-12)
    assert (rotation[:, 2, 1] > 0.0).all()


def elevations(poses: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.arcsin(poses[:, 2, 3] / np.linalg.norm(poses[:, :3, 3], axis=-1)))


def test_look_at_from_the_x_axis():
    # From +x the picture's right is +y, its up is +z, and back is +x.
    expected = [[0, 0, 1, 5], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
    np.testing.assert_array_equal(look_at(np.array([5.0, 0.0, 0.0])), expected)


def test_look_at_another_target():
    eye, target = np.array([3.0, -2.0, 4.0]), np.array([1.0, 1.0, 0.5])
    pose = look_at(eye, target)
    seen = np.linalg.inv(pose) @ np.append(target, 1.0)
    np.testing.assert_allclose(seen[:3], [0.0, 0.0, -np.linalg.norm(eye - target)], atol=1e-12)


@pytest.mark.parametrize("eye", [[0.0, 0.0, 0.0], [0.0, 0.0, 4.0], [0.0, 0.0, -4.0]])
def test_look_at_without_an_up(eye):
    with pytest.raises(ValueError, match="straight above or below"):
        look_at(np.array(eye))


@given(st.integers(1, 300), st.integers(0, 5), st.floats(0.0, 1.0))
def test_hemisphere_stays_in_its_band(count, seed, jitter):
    poses = hemisphere(count, 4.0, (5.0, 70.0), jitter, seed)
    assert poses.shape == (count, 4, 4)
    check_poses(poses, 4.0)
    assert (elevations(poses) >= 5.0 - 1e-9).all()
    assert (elevations(poses) <= 70.0 + 1e-9).all()


def test_hemisphere_without_jitter_is_the_golden_spiral():
    poses = hemisphere(4, 2.0, (0.0, 30.0), jitter=0.0)
    turn = 2.0 * np.pi * (1.0 - 1.0 / ((1.0 + np.sqrt(5.0)) / 2.0))
    expected = on_sphere(2.0, turn * np.arange(4), np.array([1, 3, 5, 7]) / 16.0)
    np.testing.assert_allclose(poses[:, :3, 3], expected, atol=1e-12)


@pytest.mark.parametrize("seed", range(2))
def test_hemisphere_is_well_spread(seed):
    count, band = 100, (2.0, 75.0)
    views = hemisphere(count, 1.0, band, seed=seed)[:, :3, 3]
    low, high = np.sin(np.deg2rad(band))
    spacing = np.sqrt(2.0 * np.pi * (high - low) / count)
    rng = np.random.default_rng(0)
    anywhere = on_sphere(1.0, rng.uniform(0.0, 2.0 * np.pi, 5000), rng.uniform(low, high, 5000))
    hole = np.linalg.norm(anywhere[:, None] - views, axis=-1).min(axis=1).max()
    between = np.linalg.norm(views[:, None] - views, axis=-1)[~np.eye(count, dtype=bool)].min()
    assert hole < 1.4 * spacing
    assert between > 0.3 * spacing


def test_orbit_of_one_elevation_is_a_circle_of_even_steps():
    poses = orbit(12, 3.0, (30.0, 30.0))
    check_poses(poses, 3.0)
    np.testing.assert_allclose(elevations(poses), 30.0)
    around = np.unwrap(np.arctan2(poses[:, 1, 3], poses[:, 0, 3]))
    np.testing.assert_allclose(np.diff(around), 2.0 * np.pi / 12)


def test_orbit_rises_and_sinks_smoothly_and_closes():
    poses = orbit(200, 4.0, (15.0, 50.0), turns=2)
    check_poses(poses, 4.0)
    heights = elevations(poses)
    assert heights[0] == pytest.approx(15.0)
    assert heights[100] == pytest.approx(50.0)
    steps = np.linalg.norm(poses[:, :3, 3] - np.roll(poses[:, :3, 3], 1, axis=0), axis=-1)
    assert steps.max() / steps.min() < 2.0
