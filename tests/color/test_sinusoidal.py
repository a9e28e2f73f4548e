"""The embedding against its formula, the written-out gradients against autograd's and finite differences."""

import itertools

import numpy as np
import pytest
import torch
from torch import nn

from ctm_plugin.color.ctm import CTMConfig, SinusoidalMLP
from ctm_plugin.color.sinusoidal import embed, embed_rows, sinusoidal_mlp


@pytest.mark.parametrize("scale", [np.pi, 1.0])
@pytest.mark.parametrize(("channels", "count"), [(3, 4), (1, 2), (5, 0), (3, 10)])
def test_both_embeddings(scale, channels, count):
    color = torch.rand(6, channels, generator=torch.Generator().manual_seed(0))
    expected = [
        list(row) + [wave(scale * 2**p * c) for wave in (np.sin, np.cos) for p in range(count) for c in row]
        for row in color.double().tolist()
    ]
    tolerance = 4e-7 * max(1, scale * 2 ** (count - 1))  # an angle's rounding
    np.testing.assert_allclose(embed(color, scale, count), expected, atol=tolerance)
    np.testing.assert_allclose(embed_rows(color, scale, count).T, expected, atol=tolerance)


def layers(channels: int, count: int, depth: int, outputs: int) -> tuple[list, list]:
    torch.manual_seed(0)
    sizes = [channels * (1 + 2 * count)] + [7] * depth + [outputs]
    linear = [nn.Linear(a, b, dtype=torch.float64) for a, b in itertools.pairwise(sizes)]
    return [layer.weight for layer in linear], [layer.bias for layer in linear]


@pytest.mark.parametrize(("count", "depth"), [(0, 1), (1, 1), (4, 1), (3, 3)])
def test_gradients_by_finite_differences(count, depth):
    weights, biases = layers(3, count, depth, 2)
    color = torch.rand(5, 3, dtype=torch.float64, requires_grad=True)
    given = [color, *weights, *biases]
    half = depth + 1
    assert torch.autograd.gradcheck(
        lambda c, *flat: sinusoidal_mlp(c, np.pi, count, flat[:half], flat[half:]), given, atol=1e-6
    )


@pytest.mark.parametrize("autocast", [False, True])
@pytest.mark.parametrize("config", [CTMConfig(), CTMConfig(P=0, k=5), CTMConfig(P=6, depth=2, frequency="unit")])
def test_module_is_its_plain_version(config, autocast):
    """Also where autocast is on, in the backward pass too."""
    torch.manual_seed(0)
    module = SinusoidalMLP(config.k, 3, config)
    color, weight = torch.rand(2, 300, config.k), torch.rand(2, 300, 3)
    found = []
    for forward in (module, module.plain):
        given = color.clone().requires_grad_()
        module.zero_grad()
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast and forward is module):
            out = forward(given)
            (out * weight).sum().backward()
        found.append([out.detach(), given.grad, *(parameter.grad for parameter in module.parameters())])
    for ours, plain in zip(*found, strict=True):
        assert ours.dtype == torch.float32
        assert (ours - plain).norm() < 2e-6 * plain.norm()


def test_no_gradient_where_none_is_asked_for():
    weights, biases = layers(3, 4, 1, 3)
    color = torch.rand(4, 3, dtype=torch.float64)
    sinusoidal_mlp(color, np.pi, 4, weights, biases).sum().backward()
    assert color.grad is None
    assert all(each.grad is not None for each in (*weights, *biases))
    with torch.no_grad():
        assert not sinusoidal_mlp(color, np.pi, 4, weights, biases).requires_grad
