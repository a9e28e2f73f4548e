"""Rays of pinhole cameras against a camera worked out by hand, and against projecting their points back."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tolerance import assert_within, gamma

from ctm_plugin.rays.cameras import Rays, camera_rays, pixel_rays, within_pixel

LEVEL = torch.eye(3, 4)[None]
HALF = math.sqrt(0.5)


def intrinsics(fx=100.0, fy=50.0, cx=3.0, cy=2.0) -> torch.Tensor:
    return torch.tensor([[fx, fy, cx, cy]])


def ray(c2w, lens, x, y) -> tuple[torch.Tensor, torch.Tensor]:
    rays = camera_rays(c2w, lens, torch.tensor([x]), torch.tensor([y]))
    return rays.origins[0], rays.directions[0]


def cameras(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Poses and lenses of all kinds."""
    rng = np.random.default_rng(seed)
    turn = Rotation.random(count, rng=rng).as_matrix()
    c2w = np.concatenate([turn, rng.uniform(-3, 3, (count, 3, 1))], axis=2)
    lens = np.concatenate([rng.uniform(5, 50, (count, 2)), rng.uniform(0, 8, (count, 2))], axis=1)
    return torch.from_numpy(c2w).float(), torch.from_numpy(lens).float()


@pytest.mark.parametrize(
    ("x", "y", "local"),
    [
        (3.0, 2.0, (0, 0, -1)),
        (103.0, 2.0, (HALF, 0, -HALF)),
        (-97.0, 2.0, (-HALF, 0, -HALF)),
        (3.0, 52.0, (0, -HALF, -HALF)),
        (3.0, -48.0, (0, HALF, -HALF)),
        (203.0, 102.0, (2 / 3, -2 / 3, -1 / 3)),
    ],
    ids=["centre", "right", "left", "down", "up", "corner"],
)
def test_level_camera(x, y, local):
    origin, direction = ray(LEVEL, intrinsics(), x, y)
    assert origin.tolist() == [0, 0, 0]
    torch.testing.assert_close(direction, torch.tensor(local, dtype=torch.float32))


@given(st.integers(0, 10**6))
def test_points_project_back(seed):
    c2w, lens = cameras(8, seed)
    x, y = torch.rand(2, 8, generator=torch.Generator().manual_seed(seed)) * 12
    rays = camera_rays(c2w, lens, x, y)
    torch.testing.assert_close(rays.directions.norm(dim=1), torch.ones(8))
    points = (rays.origins + 3.7 * rays.directions).double()
    for pose, (fx, fy, cx, cy), point, u, v in zip(c2w.double(), lens.tolist(), points, x, y, strict=True):
        right, up, back = (torch.linalg.inv(pose[:, :3]) @ (point - pose[:, 3])).tolist()
        assert back < 0
        assert cx + fx * right / -back == pytest.approx(u.item(), abs=1e-3)
        assert cy - fy * up / -back == pytest.approx(v.item(), abs=1e-3)


def test_pixels_stand_in_reading_order():
    c2w, lens = cameras(2, 0)
    height, width = 2, 3
    rays = pixel_rays(c2w, lens, height, width, torch.arange(12))
    index = 0
    for view in range(2):
        for row in range(height):
            for column in range(width):
                origin, direction = ray(c2w[view : view + 1], lens[view : view + 1], column + 0.5, row + 0.5)
                torch.testing.assert_close(rays.origins[index], origin)
                torch.testing.assert_close(rays.directions[index], direction)
                index += 1


@pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
def test_pixels_in_any_order(dtype):
    c2w, lens = cameras(3, 1)
    every = pixel_rays(c2w, lens, 4, 5, torch.arange(60))
    pixel = torch.tensor([59, 0, 20, 19, 20], dtype=dtype)
    some = pixel_rays(c2w, lens, 4, 5, pixel)
    # Sums of three terms and norms of three squares, of other numbers of rays: components are of unit vectors, their
    # terms' sizes add up to 1 at most, and so do 3 roundings of each, 3 of all three by the norm, 5 of the norm's own.
    assert_within(some.directions, every.directions[pixel], 2 * gamma(3 + 6 + 5, torch.float32))
    assert torch.equal(some.origins, every.origins[pixel])


def test_pixels_are_seen_through_the_lens_of_their_view():
    c2w, pinholes = cameras(3, 1)
    lenses = torch.tensor([[0.1, 0.01, 0.0, 0.0, 0.0], [-0.1, 0.0, 0.01, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0]])
    rays = pixel_rays(c2w, pinholes, 4, 5, torch.arange(60), lenses)
    row, column = torch.meshgrid(torch.arange(4.0), torch.arange(5.0), indexing="ij")
    for view in range(3):
        x, y = (0.5 + each.flatten() for each in (column, row))
        of_view = (each[view].expand(20, *each.shape[1:]) for each in (c2w, pinholes, lenses))
        pose, pinhole, lens = of_view
        expected = camera_rays(pose, pinhole, x, y, lens).directions
        torch.testing.assert_close(rays.directions[20 * view : 20 * view + 20], expected)
        bent = (expected - camera_rays(pose, pinhole, x, y).directions).abs().max() > 1e-6
        assert bool(bent) == (view < 2)


def test_autocast_changes_nothing():
    c2w, lens = cameras(3, 1)
    rays = pixel_rays(c2w, lens, 4, 5, torch.arange(60))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        same = pixel_rays(c2w, lens, 4, 5, torch.arange(60))
    assert torch.equal(same.directions, rays.directions)


def test_index_takes_rays():
    rays = Rays(torch.arange(12.0).reshape(4, 3), -torch.arange(12.0).reshape(4, 3))
    for index in (slice(1, 3), torch.tensor([True, False, False, True]), torch.tensor([2, 2])):
        part = rays[index]
        assert isinstance(part, Rays)
        assert torch.equal(part.origins, rays.origins[index])
        assert torch.equal(part.directions, -part.origins)


def test_points_of_packed_samples():
    rays = Rays(torch.randn(3, 3), torch.randn(3, 3))
    t, ray = torch.tensor([0.5, 2.0, 1.0, 0.0]), torch.tensor([0, 0, 2, 2])
    expected = [rays.origins[i] + s * rays.directions[i] for s, i in zip(t, ray, strict=True)]
    torch.testing.assert_close(rays.points(t, ray), torch.stack(expected))
    assert rays.points(t[:0], ray[:0]).shape == (0, 3)


@pytest.mark.parametrize("count", [1, 4, 9, 16, 25])
def test_rays_within_a_pixel(count):
    places = torch.tensor(within_pixel(count), dtype=torch.float64)
    assert places.shape == (count, 3)
    torch.testing.assert_close(places.mean(0), torch.tensor([0, 0, 0.5], dtype=torch.float64))
    assert (places[:, :2].abs() < 0.25).all()
    assert len({(x, y) for x, y, _ in within_pixel(count)}) == count  # no two through one point
    expected = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    torch.testing.assert_close(places[:, 2].sort().values, expected)  # nor with the same samples


def test_four_rays_within_a_pixel():
    """Those of a diagonal begin half a stride apart."""
    assert within_pixel(1) == [(0.0, 0.0, 0.5)]
    eighth = 0.125
    expected = [(-eighth, -eighth, 0.125), (eighth, -eighth, 0.875), (-eighth, eighth, 0.625), (eighth, eighth, 0.375)]
    assert within_pixel(4) == expected


def test_a_pixels_rays_off_its_centre():
    c2w, lens = cameras(3, 5)
    pixel = torch.tensor([0, 7, 2 * 12 + 5])
    view, row, column = torch.tensor([0, 0, 2]), torch.tensor([0, 1, 1]), torch.tensor([0, 3, 1])
    rays = pixel_rays(c2w, lens, 3, 4, pixel, right=0.25, down=-0.125)
    expected = camera_rays(c2w[view], lens[view], column + 0.75, row + 0.375)
    torch.testing.assert_close(rays.origins, expected.origins)
    torch.testing.assert_close(rays.directions, expected.directions)
