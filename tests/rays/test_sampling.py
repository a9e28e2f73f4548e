"""Where rays meet boxes, against a dense search along them; samples against a loop."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.sampling import intersect_box, march

CUBE = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
SIXTEENTHS = st.integers(0, 80).map(lambda n: n / 16)
INTERVALS = st.lists(st.tuples(SIXTEENTHS, SIXTEENTHS, st.integers(0, 15).map(lambda n: n / 16)), max_size=6)


def rays_of(*pairs) -> Rays:
    origins, directions = (torch.tensor(values, dtype=torch.float32) for values in zip(*pairs, strict=True))
    return Rays(origins, directions)


def random_rays(count: int, seed: int) -> Rays:
    """Rays in and around the box [-1, 1]^3, a third of them along axes or planes."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.rand(count, 3, generator=generator) * 6 - 3
    directions = torch.randn(count, 3, generator=generator)
    directions[: count // 3] *= torch.randint(0, 2, (count // 3, 3), generator=generator)
    directions[directions.norm(dim=1) == 0, 2] = -1.0
    return Rays(origins, directions / directions.norm(dim=1, keepdim=True))


@given(st.integers(0, 10**6), st.floats(0, 2), st.floats(2.1, 8))
def test_dense_search(seed, near, far):
    rays = random_rays(24, seed)
    box = torch.tensor([[-1.0, -0.5, -2], [0.3, 0.75, 1]])
    enter, leave = intersect_box(rays, box, near, far)
    assert ((enter >= near - 1e-6) & (leave <= far + 1e-6)).all()
    t = torch.linspace(near, far, 501, dtype=torch.float64)
    points = rays.origins[:, None].double() + t[:, None] * rays.directions[:, None].double()
    # How far inside the box each point is, negative outside.
    margin = torch.minimum(points - box[0], box[1] - points).amin(-1)
    after, before = t - enter[:, None], leave[:, None] - t
    between = torch.minimum(after, before)
    assert (between[margin > 0] >= -1e-5).all()
    assert (margin[between > 0] >= -1e-5).all()


@pytest.mark.parametrize(
    ("origin", "direction", "enter", "leave"),
    [
        ((-3, 0, 0), (1, 0, 0), 2, 4),
        ((3, 0.5, 0), (-1, 0, 0), 2, 4),
        ((0, 0, 0), (0, 0, -1), 0, 1),
        ((-2, -2, 0), (math.sqrt(0.5), math.sqrt(0.5), 0), math.sqrt(2), 3 * math.sqrt(2)),
    ],
    ids=["through", "backwards", "inside", "diagonal"],
)
def test_known_distances(origin, direction, enter, leave):
    first, last = intersect_box(rays_of((origin, direction)), CUBE, 0.0, 9.0)
    assert (first.item(), last.item()) == pytest.approx((enter, leave))


@pytest.mark.parametrize(
    ("origin", "direction"),
    [((-3, 2, 0), (1, 0, 0)), ((-3, 0, 0), (-1, 0, 0)), ((0, 0, 9), (0, 1, 0)), ((-20, 0, 0), (1, 0, 0))],
    ids=["beside", "behind", "above", "beyond_far"],
)
def test_miss(origin, direction):
    enter, leave = intersect_box(rays_of((origin, direction)), CUBE, 0.5, 9.0)
    assert leave <= enter
    assert len(march(enter, leave, 0.1)[0]) == 0


def test_near_and_far_cut():
    rays = rays_of(((-3, 0, 0), (1, 0, 0)))
    assert [x.item() for x in intersect_box(rays, CUBE, 2.5, 3.25)] == [2.5, 3.25]


@pytest.mark.parametrize("tiny", [0.0, -0.0, 1e-30, -1e-39, 1e-44])
def test_almost_parallel(tiny):
    enter, leave = intersect_box(rays_of(((-3, 0.25, 0), (1, tiny, 0))), CUBE, 0.0, 9.0)
    assert (enter.item(), leave.item()) == (2, 4)
    # In a face, a ray may count as in or out.
    for y in (-1.0, 1.0):
        enter, leave = intersect_box(rays_of(((-3, y, 0), (1, tiny, 0))), CUBE, 0.0, 9.0)
        assert (enter.item(), leave.item()) in [(2, 4), (2, 0), (2, 2)]


@given(INTERVALS, st.integers(1, 32).map(lambda n: n / 16))
def test_march(intervals, step):
    # All numbers are sixteenths, exact in float32.
    enter, leave, offset = (torch.tensor([row[i] for row in intervals], dtype=torch.float32) for i in range(3))
    expected = []
    for index, (first, last, shift) in enumerate(intervals):
        j = 0
        while first + (j + shift) * step < last:
            expected.append((first + (j + shift) * step, index))
            j += 1
    t, ray = march(enter, leave, step, offset)
    assert list(zip(t.tolist(), ray.tolist(), strict=True)) == expected
    assert ray.dtype == torch.int64


@given(st.integers(0, 10**6), st.floats(0.01, 0.5))
def test_march_of_any_numbers(seed, step):
    generator = torch.Generator().manual_seed(seed)
    enter, length, offset = torch.rand(3, 5, generator=generator)
    leave = enter + 4 * length - 0.5
    t, ray = march(enter, leave, step, offset)
    rounding = 4e-6
    assert (t >= enter[ray]).all()
    assert (t < leave[ray] + rounding).all()
    steps = (t - enter[ray]) / step - offset[ray]
    torch.testing.assert_close(steps, steps.round(), atol=1e-3, rtol=0)
    same = ray.diff() == 0
    assert (ray.diff() >= 0).all()
    torch.testing.assert_close(t.diff()[same], torch.full((int(same.sum()),), step), atol=rounding, rtol=0)
    # The next sample would be outside.
    last = torch.full((5,), -1.0).scatter_reduce(0, ray, t, "amax")
    last = torch.where(last < 0, enter + (offset - 1) * step, last)
    assert (last + step >= leave - rounding).all()


def test_default_offset_is_the_middle():
    t, ray = march(torch.tensor([1.0]), torch.tensor([2.0]), 0.25)
    assert t.tolist() == [1.125, 1.375, 1.625, 1.875]
    assert ray.tolist() == [0] * 4


def test_no_rays():
    t, ray = march(torch.zeros(0), torch.zeros(0), 0.5)
    assert t.shape == ray.shape == (0,)
