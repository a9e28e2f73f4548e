"""Means of a field's parameters against the same sums in float64."""

from types import SimpleNamespace

import pytest
import torch
from torch import nn

from ctm_plugin.backbones.averaging import STEPS_BETWEEN, WINDOWS, Averaging, follow, share


class Walking(Averaging, nn.Module):
    """One weight and one buffer, which the test moves."""

    def __init__(self, averaged: int, total_steps: int, settled: int = 0):
        super().__init__()
        self.field, self.mean_field = nn.BatchNorm1d(3), None
        self.config, self.total_steps, self.settled = SimpleNamespace(averaged=averaged), total_steps, settled


def walk(module: Walking, generator: torch.Generator) -> list[torch.Tensor]:
    """Move it at random, one step after another; the weights before each step."""
    before = []
    for step in range(module.total_steps):
        before.append(module.field.weight.detach().double().clone())
        module.average(step)
        with torch.no_grad():
            module.field.weight += torch.randn(3, generator=generator)
            module.field.running_mean += 1
    return before


@pytest.mark.parametrize(("averaged", "total", "settled"), [(8, 100, 0), (8, 100, 70), (80, 100, 0), (2, 30, 3)])
def test_the_mean_is_of_the_latest_looks(averaged, total, settled):
    module = Walking(averaged, total, settled)
    before = walk(module, torch.Generator().manual_seed(averaged))
    looks = before[max(settled, total - WINDOWS * averaged, 0) :: STEPS_BETWEEN]
    expected = looks[0]
    for count, look in enumerate(looks[1:], 1):
        part = max(min(1, 4 / averaged), 9 / (10 + count))
        expected = expected * (1 - part) + look * part
    torch.testing.assert_close(module.mean_field.weight.double(), expected, atol=1e-5, rtol=1e-5)
    assert not module.mean_field.weight.requires_grad


def test_buffers_are_those_of_the_last_look():
    module = Walking(8, 102)
    walk(module, torch.Generator())
    last = max(
        step for step in range(102) if step >= 102 - WINDOWS * 8 and (step - (102 - WINDOWS * 8)) % STEPS_BETWEEN == 0
    )
    assert module.mean_field.running_mean.tolist() == [float(last)] * 3


def test_the_noise_of_many_steps_is_averaged_away():
    torch.manual_seed(0)
    trained, mean = nn.Linear(1, 400, bias=False), nn.Linear(1, 400, bias=False)
    for count in range(400):
        nn.init.normal_(trained.weight)
        follow(mean, trained, share(count, 80))
    # Of an exponential mean with share s the variance is s / (2 - s).
    assert mean.weight.std().item() == pytest.approx((0.05 / 1.95) ** 0.5, rel=0.15)


def test_none_is_made_before_the_parts_have_their_sizes_or_without_steps_left():
    module = Walking(8, 100, settled=50)
    for step in range(50):
        module.average(step)
    assert module.mean_field is None
    for step in range(100):
        (short := Walking(8, 100, settled=100)).average(step)
    assert short.mean_field is None
