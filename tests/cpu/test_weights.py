"""Weights ray by ray against the version in torch, which GPUs run, and in float64."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.rays.volume import volume_weights


def weights_and_gradient(run, depth: torch.Tensor, ray: torch.Tensor, rays: int, seed: int) -> list[torch.Tensor]:
    rng = torch.Generator().manual_seed(seed)
    of_weights, of_transmittance = (torch.randn(n, generator=rng).to(depth.dtype) for n in (len(depth), rays))
    depth = depth.clone().requires_grad_()
    weights, transmittance = run(depth, ray, rays)
    ((weights * of_weights).sum() + (transmittance * of_transmittance).sum()).backward()
    return [weights.detach(), transmittance.detach(), depth.grad]


@given(
    st.lists(st.lists(st.sampled_from([0.0, 1e-7, 1e-3, 0.1, 1.0, 8.0, 90.0, 300.0]), max_size=12), max_size=8),
    st.integers(0, 10**6),
)
def test_torch_alone(depths, seed):
    depth = torch.tensor([value for ray in depths for value in ray])
    ray = torch.tensor([index for index, values in enumerate(depths) for _ in values], dtype=torch.long)
    found = weights_and_gradient(volume_weights, depth, ray, len(depths), seed)
    same = weights_and_gradient(volume_weights.reference, depth, ray, len(depths), seed) if len(depth) else found
    exact = weights_and_gradient(volume_weights, depth.double(), ray, len(depths), seed)
    for one, other, double in zip(found, same, exact, strict=True):
        torch.testing.assert_close(one, other, atol=2e-6, rtol=1e-5)
        torch.testing.assert_close(one.double(), double, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("ray", [[0, 1, 5], [-1, 0, 0]])
def test_samples_of_no_ray(ray):
    with pytest.raises(ValueError, match="3 depths of samples on rays"):
        volume_weights(torch.ones(3), torch.tensor(ray), 2)


def test_second_derivatives_are_refused():
    depth = torch.ones(2, requires_grad=True)
    weights, _ = volume_weights(depth, torch.zeros(2, dtype=torch.long), 1)
    (gradient,) = torch.autograd.grad(weights.square().sum(), depth, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_no_sample_at_all():
    weights, transmittance = volume_weights(torch.zeros(0), torch.zeros(0, dtype=torch.long), 3)
    assert weights.shape == (0,)
    assert transmittance.tolist() == [1, 1, 1]
