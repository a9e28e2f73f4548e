"""Volume rendering against closed forms and a loop over each ray in float64."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.autograd import gradcheck

from ctm_plugin.rays.volume import distortion, occlusion, ray_starts, segment_sums, table_weights, volume_weights

DEPTHS = st.lists(st.lists(st.floats(0, 30) | st.just(0.0), max_size=6), min_size=1, max_size=6)
FLOATS = [torch.float32, torch.float64]


def pack(depths: list[list[float]], dtype=torch.float64) -> tuple[torch.Tensor, torch.Tensor, int]:
    """The samples of each ray in one row."""
    ray = [index for index, row in enumerate(depths) for _ in row]
    flat = [depth for row in depths for depth in row]
    return torch.tensor(flat, dtype=dtype), torch.tensor(ray, dtype=torch.int64), len(depths)


def by_hand(depths: list[list[float]]) -> tuple[list[float], list[float]]:
    weights, transmittance = [], []
    for row in depths:
        light = 1.0
        for depth in row:
            weights.append(light * -math.expm1(-depth))
            light *= math.exp(-depth)
        transmittance.append(light)
    return weights, transmittance


@given(DEPTHS, st.sampled_from(FLOATS))
def test_loop_over_each_ray(depths, dtype):
    weights, transmittance = volume_weights(*pack(depths, dtype))
    assert weights.dtype == transmittance.dtype == dtype
    tolerance = 1e-6 if dtype == torch.float32 else 1e-13
    expected, left = by_hand(depths)
    np.testing.assert_allclose(weights, expected, atol=tolerance)
    np.testing.assert_allclose(transmittance, left, atol=tolerance)


@given(DEPTHS)
def test_gradients(depths):
    depth, ray, rays = pack(depths)
    # Lightly absorbing, so that all gradients are well above rounding.
    depth = (0.1 * depth).requires_grad_()
    if len(ray):
        # One output: gradcheck passes over those that need no gradient.
        assert gradcheck(lambda values: torch.cat(volume_weights(values, ray, rays)), depth)


@pytest.mark.parametrize("volume_weights", [volume_weights, volume_weights.reference])
def test_long_rows_stay_exact(volume_weights):
    rays, count = 1000, 1000
    depth = torch.rand(rays, count, generator=torch.Generator().manual_seed(0)) * 0.02
    ray = torch.arange(rays).repeat_interleave(count)
    weights, transmittance = volume_weights(depth.flatten(), ray, rays)
    exact = depth.double().numpy()
    before = np.exp(-(exact.cumsum(1) - exact))
    np.testing.assert_allclose(weights.reshape(rays, count), before * -np.expm1(-exact), rtol=2e-6)
    np.testing.assert_allclose(transmittance, np.exp(-exact.sum(1)), rtol=1e-4)


@pytest.mark.parametrize("volume_weights", [volume_weights, volume_weights.reference])
@pytest.mark.parametrize("depth", [1e3, 1e10, 1e30, math.inf])
def test_opaque_sample(depth, volume_weights):
    depths = [[0.5, depth, 0.7], [0.3, 1e-4, 0.2]]
    weights, transmittance = volume_weights(*pack(depths, torch.float32))
    stopped = -math.expm1(-0.5)
    assert weights[:3].tolist() == pytest.approx([stopped, 1 - stopped, 0])
    assert transmittance[0] == 0
    # What stands behind it in the row is another ray's.
    expected, left = by_hand(depths[1:])
    assert weights[3:].tolist() == pytest.approx(expected, rel=1e-5)
    assert transmittance[1].item() == pytest.approx(left[0])


@pytest.mark.parametrize("dtype", FLOATS)  # loops, torch
def test_opaque_sample_has_finite_gradients(dtype):
    depth, ray, rays = pack([[0.5, 1e30, 0.7], [0.3, 0.2]], dtype)
    depth.requires_grad_()
    weights, transmittance = volume_weights(depth, ray, rays)
    (gradient,) = torch.autograd.grad((weights * torch.arange(1, 6)).sum() + transmittance.sum(), depth)
    alone = depth.detach()[3:].requires_grad_()
    weights, transmittance = volume_weights(alone, ray[3:] - 1, 1)
    (expected,) = torch.autograd.grad((weights * torch.arange(4, 6)).sum() + transmittance.sum(), alone)
    torch.testing.assert_close(gradient[3:], expected)
    # Less light gets past the first sample (weight 1) to the second (weight 2).
    torch.testing.assert_close(gradient[:3], torch.tensor([-math.exp(-0.5), 0, 0], dtype=dtype))


@given(st.lists(st.integers(0, 7), max_size=20), st.integers(8, 10))
def test_starts(ray, rays):
    ray = sorted(ray)
    starts = ray_starts(torch.tensor(ray, dtype=torch.int64), rays)
    assert starts.tolist() == [sum(other < index for other in ray) for index in range(rays)]


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(-9, 9)), max_size=12))
def test_sums(pairs):
    ray = torch.tensor([index for index, _ in pairs], dtype=torch.int64)
    values = torch.tensor([[value, 2 * value] for _, value in pairs], dtype=torch.float64).reshape(-1, 2)
    expected = [[factor * sum(v for index, v in pairs if index == r) for factor in (1, 2)] for r in range(5)]
    assert segment_sums(values, ray, 5).tolist() == expected
    assert segment_sums(values[:, 0], ray, 5).tolist() == [first for first, _ in expected]


@given(st.integers(0, 10**6))
def test_distortion_is_the_sum_over_all_pairs(seed):
    random = torch.Generator().manual_seed(seed)
    counts = torch.randint(0, 7, (6,), generator=random)
    ray = torch.repeat_interleave(torch.arange(6), counts)
    weights = torch.rand(len(ray), generator=random, dtype=torch.float64) / 5
    s = torch.cat([torch.rand(int(n), generator=random, dtype=torch.float64).sort().values for n in counts])
    pairs = weights[:, None] * weights * (s[:, None] - s).abs() * (ray[:, None] == ray)
    expected = (pairs.sum() + weights.square().sum() * 0.02 / 3) / 6
    torch.testing.assert_close(distortion(weights, s, ray, 6, 0.02), expected, rtol=1e-9, atol=1e-12)


def test_distortion_of_a_long_row_is_exact():
    """Single precision in and out; running sums over all rays in single precision would lose what a ray adds."""
    random = torch.Generator().manual_seed(0)
    weights = torch.rand(20000, 10, generator=random) / 10
    s = torch.rand(20000, 10, generator=random).sort(1).values
    ray = torch.arange(20000).repeat_interleave(10)
    pairs = (weights[:, :, None] * weights[:, None] * (s[:, :, None] - s[:, None]).abs()).double()
    expected = (pairs.sum((1, 2)) + weights.double().square().sum(1) * 0.1 / 3).mean()
    found = distortion(weights.flatten(), s.flatten(), ray, 20000, 0.1)
    assert found.dtype == torch.float32
    assert found.item() == pytest.approx(expected.item(), rel=1e-6)


def test_occlusion_is_of_what_lies_in_the_nearer_half():
    weights = torch.tensor([0.5, 0.2, 0.3, 0.7], dtype=torch.float64, requires_grad=True)
    s = torch.tensor([0.0, 0.25, 0.5, 0.9], dtype=torch.float64)
    found = occlusion(weights, s, 4)
    assert found.item() == pytest.approx((0.5 * 1 + 0.2 * 0.25) / 4)
    found.backward()
    assert weights.grad.tolist() == pytest.approx([1 / 4, 1 / 16, 0, 0])


def test_occlusion_of_nothing():
    empty = torch.zeros(0, requires_grad=True)
    loss = occlusion(empty, torch.zeros(0), 4)
    loss.backward()
    assert loss.item() == 0


def test_distortion_gradient():
    ray = torch.tensor([0, 0, 0, 2, 2])
    weights = torch.tensor([0.1, 0.4, 0.3, 0.2, 0.7], dtype=torch.float64, requires_grad=True)
    s = torch.tensor([0.1, 0.2, 0.8, 0.3, 0.35], dtype=torch.float64)
    assert gradcheck(lambda w: distortion(w, s, ray, 3, 0.1), weights)


def test_distortion_of_nothing():
    empty = torch.zeros(0, requires_grad=True)
    loss = distortion(empty, torch.zeros(0), torch.zeros(0, dtype=torch.long), 4, 0.1)
    loss.backward()
    assert loss.item() == 0


# Tables of samples


@given(st.integers(0, 10**6), st.sampled_from(FLOATS))
def test_table_equals_packed(seed, dtype):
    generator = torch.Generator().manual_seed(seed)
    depth = 8 * torch.rand(5, 7, generator=generator, dtype=dtype) ** 3
    weights, transmittance = table_weights(depth)
    expected, left = volume_weights(depth.flatten(), torch.arange(5).repeat_interleave(7), 5)
    torch.testing.assert_close(weights.flatten(), expected)
    torch.testing.assert_close(transmittance, left)
    torch.testing.assert_close(weights.sum(1) + transmittance, torch.ones(5, dtype=dtype))


@pytest.mark.parametrize("dtype", FLOATS)
def test_an_endless_last_sample_stops_what_is_left(dtype):
    depth = torch.tensor([[0.1, 0.0, 1e10 * 50], [0.1, 0.2, 0.0]], dtype=dtype, requires_grad=True)
    weights, transmittance = table_weights(depth)
    torch.testing.assert_close(weights[0, 2], torch.tensor(-0.1, dtype=dtype).exp())
    torch.testing.assert_close(transmittance, torch.tensor([0.0, math.exp(-0.3)], dtype=dtype))
    (weights.square().sum() + transmittance.sum()).backward()
    assert depth.grad.isfinite().all()


def test_table_gradients():
    depth = torch.rand(4, 6, dtype=torch.float64, requires_grad=True)
    assert gradcheck(table_weights, depth)
