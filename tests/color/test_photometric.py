import math

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.color.photometric import Photometric, distance
from ctm_plugin.errors import ConfigError

PLAIN = {"mse": F.mse_loss, "l1": F.l1_loss}


def pair(rays: int = 7, channels: int = 4) -> torch.Tensor:
    return torch.rand(2, rays, channels, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("kind", PLAIN)
@pytest.mark.parametrize("weight", [0.0, 1.0, 2.5])
def test_mean_is_torch_loss(kind, weight):
    a, b = pair()
    loss = Photometric(kind=kind, weight=weight)(a, b)
    torch.testing.assert_close(loss, weight * PLAIN[kind](a, b))


@given(st.sampled_from(["mse", "l1"]), st.integers(1, 5), st.integers(1, 5))
def test_sum_over_channels_mean_over_rays(kind, rays, channels):
    a, b = pair(rays, channels)
    power = {"mse": 2, "l1": 1}[kind]
    rows = [sum(abs(x - y) ** power for x, y in zip(*row, strict=True)) for row in zip(a, b, strict=True)]
    loss = Photometric(kind=kind, weight=3.0)(a, b, "sum")
    assert loss.item() == pytest.approx(3 * float(sum(rows)) / rays)


@pytest.mark.parametrize("kind", PLAIN)
@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_gradients(kind, reduction):
    a, b = pair().unbind()
    loss = Photometric(kind=kind, weight=2.0)
    assert torch.autograd.gradcheck(lambda x, y: loss(x, y, reduction), (a.requires_grad_(), b.requires_grad_()))


def test_reductions():
    a, b = torch.tensor([[1.0, 2, 3], [4, 5, 6]]), torch.zeros(2, 3)
    assert distance(a, b, "l1", "mean") == 3.5
    assert distance(a, b, "l1", "sum") == 10.5
    assert distance(a, b) == pytest.approx(91 / 6)
    assert distance(a, b, reduction="sum") == 45.5


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"kind": "huber"}, "loss.kind"),
        ({"kind": ""}, "loss.kind"),
        ({"weight": -0.1}, "loss.weight"),
        ({"weight": math.nan}, "loss.weight"),
        ({"weight": math.inf}, "loss.weight"),
    ],
    ids=["kind", "no_kind", "negative", "nan", "inf"],
)
def test_bad_settings(settings, key):
    with pytest.raises(ConfigError, match=f"^{key}: found "):
        Photometric(**settings)


def test_unknown_kind_lists_the_known():
    with pytest.raises(ConfigError, match="'L2', expected one of mse, l1"):
        Photometric(kind="L2")
