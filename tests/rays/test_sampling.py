"""Where rays meet boxes, against a dense search along them; samples against a loop."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.sampling import importance, intersect_box, march, stratified

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
    for cut in (enter, leave):
        assert ((cut >= near - 1e-6) & (cut <= far + 1e-6)).all()
    t = torch.linspace(near, far, 501, dtype=torch.float64)
    points = rays.origins[:, None].double() + t[:, None] * rays.directions[:, None].double()
    # How far inside the box each point is, negative outside.
    margin = torch.minimum(points - box[0], box[1] - points).amin(-1)
    after, before = t - enter[:, None], leave[:, None] - t
    between = torch.minimum(after, before)
    assert (between[margin > 0] >= -1e-5).all()
    assert (margin[between > 0] >= -1e-5).all()


@pytest.mark.parametrize(
    ("origin", "direction"),
    [((-3, 2, 0), (1, 0, 0)), ((-3, 0, 0), (-1, 0, 0)), ((0, 0, 9), (0, 1, 0)), ((-20, 0, 0), (1, 0, 0))],
    ids=["beside", "behind", "above", "beyond_far"],
)
def test_miss(origin, direction):
    enter, leave = intersect_box(rays_of((origin, direction)), CUBE, 0.5, 9.0)
    assert leave <= enter
    assert len(march(enter, leave, 0.1)[0]) == 0


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


# A sample in each of equal parts


def test_stratified_without_jitter_are_the_middles():
    torch.testing.assert_close(stratified(2, 4), torch.tensor([[0.125, 0.375, 0.625, 0.875]]).expand(2, 4))


@given(st.integers(1, 40), st.integers(0, 10**6))
def test_stratified_covers_every_part_once(count, seed):
    jitter = torch.rand(30, count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    s = stratified(30, count, jitter)
    assert torch.equal((s * count).floor().long(), torch.arange(count).expand(30, count))
    torch.testing.assert_close(s * count % 1, jitter, rtol=0, atol=1e-9)


# The inverse of a distribution


def piecewise(seed: int, rays: int, bins: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Edges and weights, some of them 0."""
    generator = torch.Generator().manual_seed(seed)
    edges = 0.1 + torch.rand(rays, bins + 1, generator=generator, dtype=torch.float64)
    weights = (torch.rand(rays, bins, generator=generator, dtype=torch.float64) - 0.3).clamp_min(0)
    return edges.cumsum(1), weights


@given(st.integers(0, 10**6), st.integers(1, 12), st.integers(1, 30))
def test_importance_inverts_the_distribution(seed, bins, count):
    """The distribution function of the samples gives the u back."""
    edges, weights = piecewise(seed, 8, bins)
    u = torch.rand(8, count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    t = importance(edges, weights, u)
    share = (weights + 1e-5) / (weights + 1e-5).sum(1, keepdim=True)
    covered = ((t[..., None] - edges[:, None, :-1]) / edges.diff(dim=1)[:, None]).clamp(0, 1)
    torch.testing.assert_close((covered * share[:, None]).sum(-1), u, rtol=0, atol=1e-9)


@given(st.integers(0, 10**6))
def test_the_last_sample_is_no_farther_than_the_last_edge(seed):
    """In float32 the shares of many bins add up to a little less than 1."""
    edges, weights = (each.float() for each in piecewise(seed, 64, 200))
    assert (importance(edges, weights, torch.ones(64, 1)) <= edges[:, -1:]).all()


@given(st.integers(0, 10**6))
def test_importance_keeps_order_and_bounds(seed):
    edges, weights = piecewise(seed, 20, 9)
    u = stratified(20, 50, torch.rand(20, 50, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    t = importance(edges.float(), weights.float(), u.float())
    assert (t.diff(dim=1) >= 0).all()
    assert (t >= edges[:, :1].float()).all()
    assert (t <= edges[:, -1:].float()).all()
