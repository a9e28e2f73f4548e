"""What cameras see, against all their pixels and against projecting points one by one."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ctm_plugin.rays.cameras import camera_rays
from ctm_plugin.scene.frustum import frustum_box, reach, view_counts, visual_hull
from ctm_plugin.scene.views import Views

SEED = st.integers(0, 10**6)
HEIGHT, WIDTH = 6, 8


def views(c2w: np.ndarray, lens: np.ndarray) -> Views:
    images = torch.zeros(len(c2w), HEIGHT, WIDTH, 3, dtype=torch.uint8)
    poses, lenses = torch.from_numpy(c2w).float(), torch.from_numpy(lens).float()
    return Views(images, poses, lenses, tuple(map(str, range(len(c2w)))))


def random_views(seed: int, count: int = 3) -> Views:
    rng = np.random.default_rng(seed)
    turn = Rotation.random(count, rng=rng).as_matrix()
    lens = np.stack([*rng.uniform(5, 12, (2, count)), *rng.uniform(2, 6, (2, count))], axis=1)
    return views(np.concatenate([turn, rng.uniform(-1, 1, (count, 3, 1))], axis=2), lens)


def level(x: float = 0.0, y: float = 0.0, z: float = 0.0, focal: float = 4.0) -> Views:
    pose = np.eye(3, 4)[None].copy()
    pose[0, :, 3] = x, y, z
    return views(pose, np.array([[focal, focal, WIDTH / 2, HEIGHT / 2]]))


def seen_points(every: Views, x: torch.Tensor, y: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
    """Points at distance ``t`` behind the image points, in each view."""
    count, many = len(every), len(x)
    rays = camera_rays(
        every.c2w.repeat_interleave(many, 0),
        every.intrinsics.repeat_interleave(many, 0),
        x.repeat(count),
        y.repeat(count),
    )
    return rays.origins + t.repeat(count)[:, None] * rays.directions


@given(SEED, st.floats(0, 2), st.floats(0.1, 4))
def test_box_holds_what_is_seen(seed, near, length):
    every, far = random_views(seed), near + length
    x, y, t = torch.rand(3, 500, generator=torch.Generator().manual_seed(seed))
    points = seen_points(every, x * WIDTH, y * HEIGHT, near + t * length)
    corners_x, corners_y = torch.tensor([0.0, WIDTH, 0, WIDTH]), torch.tensor([0.0, 0, HEIGHT, HEIGHT])
    corners = [seen_points(every, corners_x, corners_y, torch.full((4,), at)) for at in (near, far)]
    points = torch.cat([points, *corners])
    low, high = frustum_box(every, near, far)
    rounding = 2e-3 * far
    assert ((points >= low - rounding) & (points <= high + rounding)).all()


def test_box_of_one_camera():
    # The image's corners lie at tangents (1, 0.75) from the axis: directions (+-1, +-0.75, -1) / 1.6008.
    # Sideways the middle of an edge reaches furthest, (1, 0, -1) / sqrt(2); forward the axis, (0, 0, -1).
    low, high = frustum_box(level(1.0, 2.0, 3.0), 1.0, 4.0)
    wide, tall = 4 * math.sqrt(0.5), 4 * 0.6
    assert low.tolist() == pytest.approx([1 - wide, 2 - tall, 3 - 4], abs=1e-3)
    assert high.tolist() == pytest.approx([1 + wide, 2 + tall, 3 - 1 / math.sqrt(1 + 1 + 0.75**2)], abs=1e-3)


@given(SEED, st.floats(0.1, 2))
def test_counts(seed, near):
    every = random_views(seed, 4)
    points = torch.rand(60, 3, generator=torch.Generator().manual_seed(seed)) * 4 - 2
    counts, too_near = view_counts(points, every, near)
    for point, count, close in zip(points.double().numpy(), counts.tolist(), too_near.tolist(), strict=True):
        number, distance, doubtful = 0, math.inf, 0
        for pose, (fx, fy, cx, cy) in zip(every.c2w.double().numpy(), every.intrinsics.tolist(), strict=True):
            right, up, back = np.linalg.solve(pose[:, :3], point - pose[:, 3])
            column, row = cx - fx * right / back, cy + fy * up / back
            margin = min(column, WIDTH - column, row, HEIGHT - row)
            number += back < 0 and margin >= 0
            doubtful += abs(margin) < 1e-3 or abs(back) < 1e-4
            distance = min(distance, math.dist(point, pose[:, 3]))
        assert abs(count - number) <= doubtful
        assert close == (distance < near) or abs(distance - near) < 1e-5


def some_alpha(every: Views, seed: int, share: float) -> Views:
    """Pictures with alpha, a share of their pixels filled."""
    alpha = torch.rand(every.images.shape[:3], generator=torch.Generator().manual_seed(seed)) < share
    rgb = torch.zeros_like(every.images)
    return dataclasses.replace(every, images=torch.cat([rgb, 255 * alpha[..., None].to(torch.uint8)], dim=-1))


@given(SEED, st.floats(0.01, 0.3), st.sampled_from([0.0, 0.02, 0.1]))
def test_outside_of_the_hull_some_picture_shows_that_nothing_is_there(seed, radius, share):
    every, random = some_alpha(random_views(seed), seed, share), torch.Generator().manual_seed(seed)
    points = 3 * torch.rand(200, 3, generator=random) - 1.5
    hull, seen = visual_hull(points, every, radius), view_counts(points, every, 0.0)[0] > 0
    around = torch.nn.functional.normalize(torch.randn(300, 3, generator=random), dim=1) * radius
    shows = torch.zeros(len(points), dtype=torch.bool)
    far = shows.clone()
    for view in range(len(every)):
        single = dataclasses.replace(every, images=every.images[view : view + 1], c2w=every.c2w[view : view + 1],
                                     intrinsics=every.intrinsics[view : view + 1], names=("one",))  # fmt: skip
        there = points[:, None] + around
        fx, fy, cx, cy = every.intrinsics[view].tolist()
        local = (there - every.c2w[view, :, 3]) @ every.c2w[view, :, :3]
        column, row = cx - fx * local[..., 0] / local[..., 2], cy + fy * local[..., 1] / local[..., 2]
        inside = (local[..., 2] < 0) & (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
        filled = every.images[view, row.long().clamp(0, HEIGHT - 1), column.long().clamp(0, WIDTH - 1), 3] > 0
        sees = view_counts(points, single, 0.0)[0] > 0
        shows |= sees & ~(inside & filled).any(1)
        # And no larger than its pixels make it: half of one's diagonal more than it looks out for.
        at = (points - every.c2w[view, :, 3]) @ every.c2w[view, :, :3]
        place = torch.stack([cy - fy * at[:, 1] / -at[:, 2], cx + fx * at[:, 0] / -at[:, 2]], dim=1)
        middles = (every.images[view, ..., 3] > 0).nonzero() + 0.5
        furthest = max(fx, fy) * reach(at.square().sum(1), -at[:, 2], radius) + 1.5 * math.sqrt(2) + 1e-3
        far |= sees & (torch.cdist(place, middles) > furthest[:, None]).all(1)
    assert not (hull & ~seen).any()
    assert not (seen & ~hull & ~shows).any()
    assert not (hull & far).any()
    if share == 0:
        assert not hull.any()


@given(SEED, st.floats(0.05, 2))
def test_a_balls_picture_reaches_so_far(seed, radius):
    """Against points of the ball's surface, of which some lie where it goes furthest."""
    random = torch.Generator().manual_seed(seed)
    middle = torch.rand(3, generator=random, dtype=torch.float64) * torch.tensor([4.0, 4.0, 3.0]) + 0.1
    found = float(reach(middle.square().sum()[None], middle[2:], radius))
    distance, angle = float(middle.norm()), math.atan2(float(middle[:2].norm()), float(middle[2]))
    if distance <= radius or angle + math.asin(radius / distance) >= math.pi / 2:
        assert found == math.inf
        return
    widest = angle + math.asin(radius / distance)
    away = torch.cat([middle[:2] / middle[:2].norm() * math.sin(widest), middle.new_tensor([math.cos(widest)])])
    touched = math.sqrt(distance**2 - radius**2) * away  # where the steepest line of sight touches it
    assert float((touched - middle).norm()) == pytest.approx(radius)
    surface = torch.nn.functional.normalize(torch.randn(500, 3, generator=random, dtype=torch.float64), dim=1)
    there = torch.cat([middle + radius * surface, touched[None]])
    apart = (there[:, :2] / there[:, 2:] - middle[:2] / middle[2]).norm(dim=1)
    assert float(apart.max()) == pytest.approx(found, rel=1e-9 / math.cos(widest))


def test_pixels_that_do_not_count_leave_room():
    every = some_alpha(level(), 0, 0.0)
    point = torch.tensor([[0.0, 0.0, -2.0]])
    assert not visual_hull(point, every, 0.1).any()
    mask = torch.ones(every.images.shape[:3], dtype=torch.bool)
    mask[:, HEIGHT // 2, WIDTH // 2] = False
    assert visual_hull(point, dataclasses.replace(every, mask=mask), 0.1).all()


@pytest.mark.parametrize("lens", [None, torch.tensor([[0.3, -0.2, 0.01, 0.02, 0.1]])])
def test_points_beside_a_camera_are_in_no_hull(lens):
    """Nor is a place looked for that is no number."""
    every = dataclasses.replace(some_alpha(level(), 0, 0.5), distortion=lens)
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1e30, 1e30, -1e-30], [0.0, 0.0, 2.0]])
    assert not visual_hull(points, every, 0.1).any()
