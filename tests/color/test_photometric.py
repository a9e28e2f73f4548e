"""Distances of colours, by sums in Python."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.color.photometric import Photometric


def pair(rays: int = 7, channels: int = 4) -> torch.Tensor:
    return torch.rand(2, rays, channels, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


@given(st.sampled_from(["mse", "l1"]), st.integers(1, 5), st.integers(1, 5))
def test_sum_over_channels_mean_over_rays(kind, rays, channels):
    a, b = pair(rays, channels)
    power = {"mse": 2, "l1": 1}[kind]
    rows = [sum(abs(x - y) ** power for x, y in zip(*row, strict=True)) for row in zip(a, b, strict=True)]
    loss = Photometric(kind=kind, weight=3.0)(a, b, "sum")
    assert loss.item() == pytest.approx(3 * float(sum(rows)) / rays)
