"""Curves against numpy, there and back; and what the entry points bring, as an installed package's."""

import math
import re

import numpy as np
import pytest
import torch
from ctm_controls.curves import Asinh, Gamma, LinearLog
from ctm_controls.equalize import Equalize
from ctm_controls.flow import Flow
from ctm_controls.whiten import Whiten
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.color.transform import fitted
from ctm_plugin.errors import ConfigError, CTMError

TOE = 1e-3
CURVES = {
    Asinh: lambda u, a: np.arcsinh(a * u) / np.arcsinh(a),
    Gamma: lambda u, a: ((u + TOE) ** (1 / a) - TOE ** (1 / a)) / ((1 + TOE) ** (1 / a) - TOE ** (1 / a)),
    LinearLog: lambda u, a: np.log1p(a * u) / np.log1p(a),
}
GREYS = torch.cat([torch.linspace(0, 1, 5001), torch.arange(256) / 255, torch.logspace(-12, 0, 400)])[:, None]


def scene(top: float, power: float = 1.0) -> torch.Tensor:
    """Colours from black to ``top``, their median at ``top / 2^power``."""
    return top * torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) ** power


def light(color: np.ndarray) -> np.ndarray:
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("kind", CURVES)
@given(top=st.sampled_from([0.002, 0.01, 0.1, 0.5, 1.0]), power=st.sampled_from([0.1, 1.0, 5.0]))
def test_a_curve_is_its_formula_and_comes_back(kind, top, power):
    space = kind()
    space.begin(scene(top, power))
    greys = GREYS.expand(-1, 3)
    latent = space.encode(greys)
    of = light if kind is LinearLog else np.asarray
    part = of(greys.double().numpy()) / of(np.array(float(space.level)))
    np.testing.assert_allclose(space.encode(greys.double()), 0.9 * CURVES[kind](part, float(space.a)), atol=1e-9)
    assert (latent[greys == 0] == 0).all()
    torch.testing.assert_close(space.decode(latent), greys, atol=1e-6, rtol=0)
    assert torch.equal(space.decode(-latent.abs()), torch.zeros_like(latent))


@pytest.mark.parametrize("kind", CURVES)
@given(st.floats(0.01, 0.9), st.floats(1.1, 1.8))
def test_the_median_goes_to_the_middle_of_the_range(kind, top, power):
    rgb, space = scene(top, power), kind()
    latent = fitted(space, torch.cat([torch.zeros(5000, 3), rgb]))
    assert space.bounds[0] < float(space.a) < space.bounds[1]
    assert float(latent[5000:].median()) == pytest.approx(0.45, abs=1e-4)


@pytest.mark.parametrize("kind", CURVES)
def test_gradients_are_finite(kind):
    space = kind()
    space.begin(scene(0.02, 2.0))
    color = torch.tensor([0.0, 1e-12, 1e-4, 0.5, 0.99]).double()[:, None].repeat(1, 3).requires_grad_()
    latent = space.encode(color)
    (forth,) = torch.autograd.grad(latent.sum(), color)
    latent = latent.detach().requires_grad_()
    (back,) = torch.autograd.grad(space.decode(latent).sum(), latent)
    assert forth.isfinite().all()
    assert back.isfinite().all()
    torch.testing.assert_close((forth * back)[1:], torch.ones_like(back)[1:], atol=1e-3, rtol=0)


ALL = [*CURVES, Equalize, Whiten, Flow]


@pytest.mark.parametrize("kind", ALL)
def test_a_fit_is_in_the_state_and_in_its_description(kind):
    space, other = kind(), kind()
    space.begin(scene(0.1))
    other.load_state_dict(space.state_dict())
    colors = GREYS.expand(-1, 3)
    assert torch.equal(other.encode(colors), space.encode(colors))
    assert torch.equal(other.decode(colors), space.decode(colors))
    assert other.describe() == space.describe() != kind().describe()


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize(("bad", "found"), [(0.0, "that are all black"), (torch.nan, "with NaN")])
def test_degenerate_colours_are_refused(kind, bad, found):
    space = kind()
    space.label = "color_space=mine"
    with pytest.raises(CTMError, match=f"color_space=mine: found training colours {found}"):
        space.begin(torch.full((5, 3), bad))


@pytest.mark.parametrize("kind", ALL)
def test_half_precision_and_rows_that_are_not_contiguous(kind):
    space, half = kind(), scene(0.1).half()
    space.begin(scene(0.1))
    assert torch.equal(space.encode(half), space.encode(half.float()))
    inside = half.clamp(max=0.09)  # a gain flattens what is above the scene's level
    latent = space.encode(inside).T.contiguous().T
    torch.testing.assert_close(space.decode(latent), inside.float(), atol=5e-6, rtol=0)


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (Equalize, {"steepest": 1.9}, "color_space.steepest: found 1.9, expected a number in [2, 255]"),
        (Equalize, {"steepest": math.nan}, "color_space.steepest: found nan, expected a number in [2, 255]"),
        (Whiten, {"shrink": 1.1}, "color_space.shrink: found 1.1, expected a number in [0.01, 1]"),
        (Flow, {"bins": 0}, "ctm.bins: found 0"),
        (Flow, {"heaviest": 0.5}, "ctm.heaviest: found 0.5"),
    ],
)
def test_settings_that_cannot_be(kind, settings, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        kind.Config(**settings)
