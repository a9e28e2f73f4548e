"""All of space in a ball: inverses, where points go, and what lengths become."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.rays.contraction import BALL_RADIUS, END_PACE, contract, lengths, paced, travelled

SEED = st.integers(0, 10**6)


def points(seed: int, size: float, count: int = 50) -> torch.Tensor:
    rng = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=rng, dtype=torch.float64), dim=1)
    return directions * size ** (2 * torch.rand(count, 1, generator=rng, dtype=torch.float64) - 1)


@given(SEED, st.floats(1.01, 1e4))
def test_all_of_space_lies_in_the_ball_on_its_rays(seed, size):
    x = points(seed, size)
    c = contract(x)
    assert (c.norm(dim=1) < BALL_RADIUS).all()
    inside = x.norm(dim=1) <= 1
    assert torch.equal(c[inside], x[inside])
    norm = x[~inside].norm(dim=1)
    torch.testing.assert_close(c[~inside].norm(dim=1), 2 - 1 / norm)
    torch.testing.assert_close(c[~inside] / c[~inside].norm(dim=1, keepdim=True), x[~inside] / norm[:, None])


def test_worked_out_by_hand():
    x = torch.tensor([[0.0, 0.0, 0.0], [0.6, 0.0, 0.8], [0.0, 4.0, 0.0], [0.0, 0.0, -10.0]])
    expected = torch.tensor([[0.0, 0.0, 0.0], [0.6, 0.0, 0.8], [0.0, 1.75, 0.0], [0.0, 0.0, -1.9]])
    torch.testing.assert_close(contract(x), expected)
    paces = torch.tensor([0.5, 2.0, 3.0, 3.5])
    torch.testing.assert_close(travelled(paces), torch.tensor([0.5, 2.0, 4.0, 8.0]))


@given(SEED, st.floats(1.01, 1e4))
def test_nothing_is_drawn_longer(seed, size):
    """The Jacobian's singular values: 1 inside; outside 1/|x|^2 along x, (2 - 1/|x|)/|x| across, at most 1."""
    x = points(seed, size, 20)
    for each in x:
        norm = each.norm().item()
        values = torch.linalg.svdvals(torch.autograd.functional.jacobian(contract, each))
        expected = [1.0] * 3 if norm <= 1 else sorted([norm**-2, *[(2 - 1 / norm) / norm] * 2], reverse=True)
        torch.testing.assert_close(values, torch.tensor(expected, dtype=torch.float64), rtol=1e-6, atol=1e-12)


@given(st.floats(1e-3, 1e6))
def test_paces_and_distances(distance):
    far = torch.tensor([distance], dtype=torch.float64)
    pace = paced(far)
    assert 0 < pace.item() < END_PACE
    torch.testing.assert_close(travelled(pace), far, rtol=1e-6, atol=0)


def test_paces_go_on_smoothly():
    pace = torch.tensor([1.999, 2.001, 3.0], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(travelled(pace).sum(), pace)
    torch.testing.assert_close(slope, torch.tensor([1.0, 1.001, 4.0], dtype=torch.float64), rtol=1e-4, atol=0)


@pytest.mark.parametrize("away", [0.0, 0.5, 1.0])
def test_a_ray_s_length_in_the_ball(away):
    """Straight out from the middle: all that is left of the ball, by the contraction itself."""
    pace = torch.linspace(0, END_PACE, 100_001, dtype=torch.float64)[:-1]
    middle = (pace[1:] + pace[:-1]) / 2
    places = torch.tensor([[away, 0.0, 0.0]], dtype=torch.float64) + travelled(middle)[:, None] * torch.tensor(
        [[1.0, 0.0, 0.0]], dtype=torch.float64
    )
    c = contract(places)
    found = (lengths(middle, c) * pace.diff()).sum().item()
    assert found == pytest.approx(BALL_RADIUS - away, rel=1e-3)
    assert math.isfinite(found)
