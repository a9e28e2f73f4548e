"""Paths for videos, against their closed forms."""

import math

import numpy as np
import pytest
import torch
from ctm_scenes.trajectory import hemisphere, look_at
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from ctm_plugin.scene.camera_paths import EASE, KeyFrames, capture, eased, focus, orbit, spiral, visiting_order
from ctm_plugin.scene.views import Views


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


def test_two_turns_close():
    """The step over the end is as long as its neighbours."""
    eyes = spiral(cross(), 2.0, 8.0, frames=120)[:, :, 3]
    steps = (eyes - eyes.roll(1, 0)).norm(dim=1)
    assert steps[0] == pytest.approx(steps[1].item(), rel=0.1)


def ring(count: int, radius: float, height: float, centre: np.ndarray) -> np.ndarray:
    """Cameras on a circle that look at its axis, z up."""
    angle = 2 * np.pi * np.arange(count) / count
    place = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)], axis=1)
    return look_at(place + centre, centre)[:, :3]


def test_the_orbit_of_cameras_on_a_circle_is_that_circle():
    centre = np.array([1.0, -2.0, 0.5])
    c2w = ring(8, 3.0, 1.5, centre)
    np.testing.assert_allclose(orbit(views(c2w), 8).numpy(), c2w, atol=1e-5)


@pytest.mark.parametrize("path", [orbit, lambda views, frames: spiral(views, 3.0, 9.0, frames), capture])
def test_a_path_moves_with_the_world(path):
    c2w, move = hemisphere(30, 4.0, seed=3), np.eye(4)
    move[:3, :3], move[:3, 3] = Rotation.from_rotvec([0.4, -0.9, 0.3]).as_matrix(), [1.0, 2.0, -0.5]
    still, moved = (path(views(poses), 5).double().numpy() for poses in (c2w, move @ c2w))
    np.testing.assert_allclose(moved, move[:3, :3] @ still + [[0, 0, 0, at] for at in move[:3, 3]], atol=1e-4)


def test_orbits_are_rigid_and_look_at_the_middle():
    poses = orbit(views(np.asarray(hemisphere(40, 4.0, seed=1))), 12).double().numpy()
    turns = poses[:, :, :3]
    np.testing.assert_allclose(turns.transpose(0, 2, 1) @ turns, np.tile(np.eye(3), (12, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(turns), 1, atol=1e-6)
    middle = poses[:, :, 3] - np.linalg.norm(poses[:, :, 3], axis=1, keepdims=True) * turns[:, :, 2]
    assert np.abs(middle).max() < 0.2


def test_one_camera_has_an_orbit_too():
    assert torch.isfinite(orbit(views(hemisphere(1, 4.0, seed=1)), 3)).all()


@pytest.fixture(scope="module")
def arc() -> np.ndarray:
    """Twelve cameras on a third of a circle round the origin, unevenly apart, in order."""
    angles = np.radians(np.sort(np.random.default_rng(0).uniform(0, 120, 12)))
    back = np.stack([np.cos(angles), np.sin(angles), np.zeros(12)], 1)
    up = np.tile([0.0, 0.0, 1.0], (12, 1))
    return np.stack([np.cross(up, back), up, back, 4 * back], 2)


def test_the_film_stays_among_the_cameras_and_begins_and_ends_slowly(arc):
    poses = capture(views(arc), 40).double().numpy()
    eyes = poses[:, :, 3]
    assert (eyes >= arc[:, :, 3].min(0) - 1e-6).all()
    assert (eyes <= arc[:, :, 3].max(0) + 1e-6).all()
    steps = np.linalg.norm(np.diff(eyes, axis=0), axis=1)
    middle = steps[7:-7]
    assert middle.max() < 1.1 * middle.min()
    assert max(steps[0], steps[-1]) < 0.2 * middle.min()
    assert steps.sum() > 0.5 * np.linalg.norm(np.diff(arc[:, :, 3], axis=0), axis=1).sum()
    np.testing.assert_allclose(
        poses[:, :, :3].transpose(0, 2, 1) @ poses[:, :, :3], np.tile(np.eye(3), (40, 1, 1)), atol=1e-6
    )
    # All cameras look at the origin, so the film does.
    assert ((eyes / np.linalg.norm(eyes, axis=1, keepdims=True) * poses[:, :, 2]).sum(1) > 0.99).all()


def test_a_film_is_eased():
    """The speed is a trapezoid of area 1: symmetric, even between the ramps, and half of that half way up them."""
    times = np.linspace(0, 1, 1001)
    along = eased(times)
    np.testing.assert_allclose(along + along[::-1], 1, atol=1e-12)
    speed = np.gradient(along, times)
    np.testing.assert_allclose(speed[200:800], 1 / (1 - EASE), rtol=1e-9)
    np.testing.assert_allclose(np.interp(EASE / 2, times, speed), 0.5 / (1 - EASE), rtol=1e-2)
    assert speed[0] < 0.01


def test_names_in_no_order_make_the_same_film(arc):
    shuffled = arc[np.random.default_rng(1).permutation(len(arc))]
    there, back = (capture(views(each), 16).double().numpy() for each in (arc, shuffled))
    off = min(np.abs(there - each).max() for each in (back, back[::-1]))
    assert off < 1e-5
    assert list(visiting_order(arc[:, :, 3])) == list(range(len(arc)))


def test_one_place_is_a_film_too():
    still = np.tile(np.eye(4)[None, :3], (3, 1, 1))
    np.testing.assert_allclose(
        capture(views(still), 5).double().numpy(), np.tile(np.eye(4)[None, :3], (5, 1, 1)), atol=1e-6
    )


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
