"""Paths for videos, against their closed forms, the spiral against NeRF's own way of making it too."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ctm_plugin.scene.camera_paths import capture, focus, orbit, spiral, walk
from ctm_plugin.scene.views import Views
from ctm_plugin.scenes.trajectory import forward_facing, hemisphere


def views(c2w: np.ndarray) -> Views:
    count = len(c2w)
    images = torch.zeros(count, 4, 4, 3, dtype=torch.uint8)
    lens = torch.tensor([[4.0, 4, 2, 2]]).repeat(count, 1)
    return Views(images, torch.from_numpy(c2w[:, :3]).float(), lens, tuple(map(str, range(count))))


def cross(x: float = 2.0, y: float = 1.0, z: float = 0.5) -> Views:
    """Six level cameras on a cross: every 90th percentile is half way between the two largest and the next."""
    c2w = np.tile(np.eye(4), (6, 1, 1))
    c2w[:, :3, 3] = [[x, 0, 0], [-x, 0, 0], [0, y, 0], [0, -y, 0], [0, 0, z], [0, 0, -z]]
    return views(c2w)


def test_focus():
    # Disparities 1/2 and 1/(5*8): a quarter of the one and three quarters of the other.
    assert focus(2.0, 8.0) == pytest.approx(1 / (0.125 + 0.01875))


def test_closed_form():
    poses = spiral(cross(), 2.0, 8.0, frames=8, turns=2).double()
    radii = np.array([2.0, 1.0, 0.5])  # of six distances two are these, and the others 0
    deep = 1 / (0.125 + 0.01875)
    for index, pose in enumerate(poses.numpy()):
        angle = 2 * math.pi * 2 * index / 8
        eye = radii * [math.cos(angle), -math.sin(angle), -math.sin(angle / 2)]
        np.testing.assert_allclose(pose[:, 3], eye, atol=1e-6)
        away = np.array([0, 0, -deep]) - eye
        np.testing.assert_allclose(-pose[:, 2], away / np.linalg.norm(away), atol=1e-6)
        np.testing.assert_allclose(pose[:, :3].T @ pose[:, :3], np.eye(3), atol=1e-6)
        assert np.linalg.det(pose[:, :3]) > 0
        assert pose[1, 0] == pytest.approx(0, abs=1e-6)  # level: right has no part upwards
        assert pose[1, 1] > 0


def test_it_follows_the_scene():
    """A moved and turned scene has the moved and turned path."""
    c2w = forward_facing(9, (0.0, -4.0, 0.0), (0.0, 1.0, 0.3), (0.6, 0.4), seed=1)
    move = np.eye(4)
    move[:3, :3] = Rotation.random(rng=np.random.default_rng(0)).as_matrix()
    move[:3, 3] = 1.0, -2.0, 0.5
    still, moved = (spiral(views(poses), 3.0, 9.0, 16).double().numpy() for poses in (c2w, move @ c2w))
    np.testing.assert_allclose(moved, move[:3, :3] @ still + [[0, 0, 0, at] for at in move[:3, 3]], atol=1e-5)


def test_two_turns_close():
    """The step over the end is as long as its neighbours."""
    eyes = spiral(cross(), 2.0, 8.0, frames=120)[:, :, 3]
    steps = (eyes - eyes.roll(1, 0)).norm(dim=1)
    assert steps[0] == pytest.approx(steps[1].item(), rel=0.1)
    assert spiral(cross(), 2.0, 8.0, frames=1).shape == (1, 3, 4)


def ring(count: int, radius: float, height: float, centre: np.ndarray) -> np.ndarray:
    """Cameras on a circle that look at its axis, z up."""
    angle = 2 * np.pi * np.arange(count) / count
    place = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)], axis=1)
    back = place / np.linalg.norm(place, axis=1, keepdims=True)
    right = np.cross([0.0, 0, 1], back)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(back, right), back, place + centre], axis=2)


def test_the_orbit_of_cameras_on_a_circle_is_that_circle():
    centre = np.array([1.0, -2.0, 0.5])
    c2w = ring(8, 3.0, 1.5, centre)
    np.testing.assert_allclose(orbit(views(c2w), 8).numpy(), c2w, atol=1e-5)


def test_an_orbit_moves_with_the_world():
    c2w = np.asarray(hemisphere(30, 4.0, seed=3))
    move = np.eye(4)
    move[:3, :3], move[:3, 3] = Rotation.from_rotvec([0.4, -0.9, 0.3]).as_matrix(), [1.0, 2.0, -0.5]
    still, moved = orbit(views(c2w), 5).double().numpy(), orbit(views(move @ c2w), 5).double().numpy()
    whole = np.concatenate([still, np.tile([[[0.0, 0, 0, 1]]], (5, 1, 1))], axis=1)
    np.testing.assert_allclose(moved, (move @ whole)[:, :3], atol=1e-4)


def test_orbits_are_rigid_and_look_at_the_middle():
    poses = orbit(views(np.asarray(hemisphere(40, 4.0, seed=1))), 12).double().numpy()
    turns = poses[:, :, :3]
    np.testing.assert_allclose(turns.transpose(0, 2, 1) @ turns, np.tile(np.eye(3), (12, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(turns), 1, atol=1e-6)
    middle = poses[:, :, 3] - np.linalg.norm(poses[:, :, 3], axis=1, keepdims=True) * turns[:, :, 2]
    assert np.abs(middle).max() < 0.2


def test_one_camera_has_an_orbit_too():
    assert torch.isfinite(orbit(views(np.asarray(hemisphere(1, 4.0, seed=1))), 3)).all()


@pytest.fixture(scope="module")
def arc() -> np.ndarray:
    """Twelve cameras on a third of a circle round the origin, unevenly apart, in order."""
    angles = np.radians(np.sort(np.random.default_rng(0).uniform(0, 120, 12)))
    back = np.stack([np.cos(angles), np.sin(angles), np.zeros(12)], 1)
    up = np.tile([0.0, 0.0, 1.0], (12, 1))
    return np.stack([np.cross(up, back), up, back, 4 * back], 2)


def test_the_film_stays_among_the_cameras_and_keeps_its_pace(arc):
    poses = capture(views(arc), 40).double().numpy()
    eyes = poses[:, :, 3]
    assert (eyes >= arc[:, :, 3].min(0) - 1e-6).all()
    assert (eyes <= arc[:, :, 3].max(0) + 1e-6).all()
    steps = np.linalg.norm(np.diff(eyes, axis=0), axis=1)
    assert steps.max() < 1.1 * steps.min()
    assert steps.sum() > 0.5 * np.linalg.norm(np.diff(arc[:, :, 3], axis=0), axis=1).sum()
    np.testing.assert_allclose(
        poses[:, :, :3].transpose(0, 2, 1) @ poses[:, :, :3], np.tile(np.eye(3), (40, 1, 1)), atol=1e-6
    )
    # All cameras look at the origin, so the film does.
    assert ((eyes / np.linalg.norm(eyes, axis=1, keepdims=True) * poses[:, :, 2]).sum(1) > 0.99).all()


def test_names_in_no_order_make_the_same_film(arc):
    shuffled = arc[np.random.default_rng(1).permutation(len(arc))]
    there, back = (capture(views(each), 16).double().numpy() for each in (arc, shuffled))
    off = min(np.abs(there - each).max() for each in (back, back[::-1]))
    assert off < 1e-5
    assert list(walk(arc[:, :, 3])) == list(range(len(arc)))


def test_one_place_is_a_film_too():
    still = np.tile(np.eye(4)[None, :3], (3, 1, 1))
    np.testing.assert_allclose(
        capture(views(still), 5).double().numpy(), np.tile(np.eye(4)[None, :3], (5, 1, 1)), atol=1e-6
    )
