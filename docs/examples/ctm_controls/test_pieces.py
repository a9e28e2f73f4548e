"""Curves of straight pieces against numpy, there and back, inside and beyond."""

import numpy as np
import torch
from ctm_controls.pieces import along, back
from hypothesis import given
from hypothesis import strategies as st


def curves(count: int, seed: int) -> torch.Tensor:
    rises = 0.1 + torch.rand(3, count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.pad(rises.cumsum(1), (1, 0)) - 0.3


@given(st.integers(1, 20), st.integers(0, 99))
def test_inside_they_agree_with_numpy(count, seed):
    knots, places = curves(count, seed), torch.rand(2, 50, 3, dtype=torch.float64)
    values, slopes = along(knots, places)
    grid = np.linspace(0, 1, count + 1)
    for channel in range(3):
        expected = np.interp(places[..., channel], grid, knots[channel])
        np.testing.assert_allclose(values[..., channel], expected, atol=1e-12)
        again = np.interp(values[..., channel], knots[channel], grid)
        np.testing.assert_allclose(back(knots, values)[..., channel], again, atol=1e-12)
    moved = (along(knots, places + 1e-9)[0] - values) / 1e-9
    inside = (count * places % 1 < 0.999).all(-1)
    torch.testing.assert_close(moved[inside], slopes[inside], atol=1e-5, rtol=0)


@given(st.integers(1, 20), st.integers(0, 99))
def test_the_outer_pieces_go_on(count, seed):
    knots = curves(count, seed)
    places = torch.tensor([[-2.0] * 3, [3.0] * 3], dtype=torch.float64)
    values, slopes = along(knots, places)
    torch.testing.assert_close(slopes, count * torch.stack([knots[:, 1] - knots[:, 0], knots[:, -1] - knots[:, -2]]))
    torch.testing.assert_close(values[0], knots[:, 0] - 2 * slopes[0])
    torch.testing.assert_close(values[1], knots[:, -1] + 2 * slopes[1])
    torch.testing.assert_close(back(knots, values), places)


def test_knots_are_met_exactly():
    knots = curves(8, 0)
    places = (torch.arange(9, dtype=torch.float64) / 8)[:, None].expand(-1, 3)
    torch.testing.assert_close(along(knots, places)[0], knots.T, atol=0, rtol=1e-15)
    assert torch.equal(back(knots, knots.T), places)


def test_gradients_reach_knots_and_values_both_ways():
    knots, places = curves(4, 1).requires_grad_(), torch.rand(5, 3, dtype=torch.float64).mul(0.24).requires_grad_()
    assert torch.autograd.gradcheck(lambda k, p: along(k, p), (knots, places))
    values = along(knots, places)[0].detach().requires_grad_()
    assert torch.autograd.gradcheck(back, (knots, values))
