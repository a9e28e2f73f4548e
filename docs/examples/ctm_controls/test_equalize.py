"""The scene's own curve: what it finds of planted distributions, its bounds, its inverse."""

import numpy as np
import torch
from ctm_controls.equalize import Equalize as Space
from hypothesis import given
from hypothesis import strategies as st

GREYS = torch.cat([torch.linspace(0, 1, 5001), torch.arange(256) / 255, torch.logspace(-12, 0, 200)])


def fit(rgb: torch.Tensor, **settings) -> Space:
    space = Space(Space.Config(**settings))
    space.begin(rgb)
    return space


def curve(space: Space, greys: torch.Tensor) -> torch.Tensor:
    return space.encode(greys[:, None].expand(-1, 3))[:, 0]


def drawn(top: float, power: float = 1.0) -> torch.Tensor:
    return top * torch.rand(8000, 3, generator=torch.Generator().manual_seed(0)) ** power


@given(st.sampled_from([0.004, 0.02, 0.2, 1.0]), st.sampled_from([0.3, 1.0, 4.0]), st.sampled_from([2.0, 64.0, 255.0]))
def test_all_colours_come_back_along_a_curve_whose_slopes_are_bounded(top, power, steepest):
    space = fit(drawn(top, power), steepest=steepest)
    latent = curve(space, GREYS)
    torch.testing.assert_close(space.decode(latent[:, None].expand(-1, 3))[:, 0], GREYS, atol=1e-6, rtol=0)
    knots = space.knots.double()
    assert (knots[0], knots[-1]) == (0, 1)
    slopes = 255 * knots.diff()
    assert slopes.min() > 0.099
    assert slopes.max() < 1.01 * steepest
    assert torch.equal(curve(space, torch.tensor([0.0, 1.0])), torch.tensor([0.0, 1.0]))
    assert torch.equal(space.decode(torch.tensor([[0.0] * 3, [1.0] * 3])), torch.tensor([[0.0] * 3, [1.0] * 3]))


def test_where_no_bound_is_met_it_is_the_cumulative_histogram():
    levels = torch.arange(1, 256)
    counts = 40 + levels
    rgb = (torch.repeat_interleave(levels, counts) / 255)[:, None].expand(-1, 3)
    space = fit(torch.cat([torch.zeros(100000, 3), rgb]))
    expected = np.concatenate([[0], counts.double().cumsum(0)]) / float(counts.sum())
    np.testing.assert_allclose(space.knots, expected, atol=1e-4)
    between = (torch.arange(255) + 0.25) / 255
    np.testing.assert_allclose(curve(space, between), np.interp(between, np.arange(256) / 255, expected), atol=1e-4)


def test_bounded_slopes_share_what_the_others_leave():
    """Two levels in equal parts: both as steep as may be, the rest spread evenly over those that have none."""
    rgb = torch.tensor([3.0, 10.0]).repeat(50)[:, None].expand(-1, 3) / 255
    slopes = 255 * fit(rgb, steepest=50.0).knots.double().diff()
    held = torch.tensor([2, 9])
    torch.testing.assert_close(slopes[held], torch.full((2,), 50.0).double(), atol=0.1, rtol=0)
    rest = slopes[[i for i in range(255) if i not in held]]
    torch.testing.assert_close(rest, torch.full((253,), (255 - 100) / 253).double(), atol=1e-2, rtol=0)


def test_a_dark_scene_fills_the_range():
    rgb = drawn(0.1)
    latent = fit(rgb).encode(rgb)
    expected = torch.tensor([0.1, 0.5, 0.8])
    torch.testing.assert_close(latent.quantile(torch.tensor([0.1, 0.5, 0.8])), expected, atol=0.1, rtol=0)


def test_gradients_are_the_slopes():
    space = fit(drawn(0.1))
    color = ((torch.arange(255).double() + 0.5) / 255)[:, None].repeat(1, 3).requires_grad_()
    (forth,) = torch.autograd.grad(space.encode(color).sum(), color)
    torch.testing.assert_close(forth[:, 0], 255 * space.knots.double().diff())
    for function, bound in ((space.encode, 0.0), (space.decode, 1e-3)):  # torch >= 2.14 gives a clamp's bounds no slope
        ends = torch.tensor([[bound] * 3, [1 - bound] * 3]).requires_grad_()
        (gradient,) = torch.autograd.grad(function(ends).sum(), ends)
        assert gradient.isfinite().all()
        assert (gradient > 0).all()
    ends = torch.tensor([[0.0] * 3, [1.0] * 3]).requires_grad_()
    assert torch.autograd.grad(space.decode(ends).sum(), ends)[0].isfinite().all()
