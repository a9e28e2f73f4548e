"""Networks of features and directions against their formula in float64, in blocks and whole."""

import pytest
import torch
import torch.nn.functional as F

from ctm_plugin.backbones.networks import FeaturesAndDirections, ViewMLP
from ctm_plugin.cpu import blocked_mlp
from ctm_plugin.rays.encoding import embed

FEATURES = 4


def directions_of(count: int) -> torch.Tensor:
    return F.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(0)), dim=1)


@pytest.mark.parametrize(("channels", "depth", "frequencies"), [(3, 2, 0), (1, 2, 4), (5, 4, 1)])
def test_view_mlp(channels, depth, frequencies):
    mlp = ViewMLP(FEATURES, channels, width=8, depth=depth, frequencies=frequencies)
    features, directions = torch.randn(6, FEATURES), directions_of(3)
    ray = torch.tensor([0, 0, 1, 1, 1, 2])
    matrices, biases = list(mlp.parameters())[::2], list(mlp.parameters())[1::2]
    assert len(matrices) == depth
    assert not biases[-1].any()
    d = directions[ray].double()
    hidden = torch.cat(
        [features.double(), d]
        + [torch.sin(2**p * d) for p in range(frequencies)]
        + [torch.cos(2**p * d) for p in range(frequencies)],
        dim=1,
    )
    for index, (matrix, bias) in enumerate(zip(matrices, biases, strict=True)):
        hidden = (hidden if index == 0 else hidden.clamp_min(0)) @ matrix.double().T + bias.double()
    torch.testing.assert_close(mlp(features, directions, ray).double(), 1 / (1 + torch.exp(-hidden)), atol=1e-6, rtol=0)


def view_gradients(mlp, features, directions, ray, way):
    """Output and gradients of one look at samples: in ``blocks``, ``whole``, or as the module does."""
    features = features.clone().requires_grad_()
    mlp.zero_grad()
    embedded, layers = embed(directions, mlp.frequencies), mlp.layers[::2]
    if way == "blocks":
        weights, biases = [layer.weight for layer in layers], [layer.bias for layer in layers]
        out = blocked_mlp.blocked_mlp(features, FeaturesAndDirections(embedded, ray), weights, biases)
    else:
        out = mlp.whole(features, embedded, ray) if way == "whole" else mlp(features, directions, ray)
    (out * torch.arange(1.0, out.numel() + 1).view_as(out).cos()).sum().backward()
    return [out, features.grad, *(parameter.grad for parameter in mlp.parameters())]


@pytest.mark.parametrize("samples", [0, 1, 8, 21])
@pytest.mark.parametrize("way", ["blocks", "module"])
def test_view_mlp_is_the_whole(samples, way, monkeypatch):
    monkeypatch.setattr(blocked_mlp, "BLOCK_BYTES", 11 * 24 * 4)  # of the widest layer, the entry: whole strides of it
    monkeypatch.setattr(blocked_mlp, "ROW_MULTIPLE", 4)
    mlp = ViewMLP(FEATURES, 3, width=8, depth=3, frequencies=2)
    features, directions = torch.randn(samples, FEATURES), directions_of(5)
    ray = torch.randint(5, (samples,)).sort().values
    found, expected = (view_gradients(mlp, features, directions, ray, each) for each in (way, "whole"))
    for ours, plain in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, plain, atol=1e-6, rtol=1e-5)


def test_view_mlp_in_blocks_with_bfloat16_products():
    torch.manual_seed(0)
    mlp = ViewMLP(FEATURES, 3, width=64, depth=3, frequencies=4)
    features, directions = torch.randn(500, FEATURES), directions_of(5)
    ray = torch.randint(5, (500,)).sort().values
    exact = view_gradients(mlp, features, directions, ray, "whole")
    with torch.autocast("cpu", torch.bfloat16):
        blocks, plain = (view_gradients(mlp, features, directions, ray, way) for way in ("module", "whole"))
    for ours, theirs, true in zip(blocks, plain, exact, strict=True):
        assert ours.dtype == torch.float32
        assert 0 < (ours - true).norm() < 1.2 * (theirs - true).norm() + 1e-3 * true.norm()
