"""Whitening: against numpy's eigenvalues, its range, its inverse on the whole cube."""

import numpy as np
import pytest
import torch
from ctm_controls.whiten import Whiten as Space
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.color.transform import fitted

AXIS = torch.linspace(0, 1, 11)
CUBE = torch.cartesian_prod(AXIS, AXIS, AXIS)


def scene(top: float = 0.1, chroma: float = 0.1) -> torch.Tensor:
    """Colours of a luminance each, and a little chroma."""
    generator = torch.Generator().manual_seed(0)
    grey, each = torch.rand(6000, 1, generator=generator), torch.rand(6000, 3, generator=generator)
    return top * ((1 - chroma) * grey + chroma * each)


def fit(rgb: torch.Tensor, **settings) -> Space:
    space = Space(Space.Config(**settings))
    space.begin(rgb)
    return space


@given(
    st.sampled_from([0.005, 0.05, 0.5, 1.0]), st.sampled_from([0.0, 0.02, 0.3, 1.0]), st.sampled_from([0.01, 0.1, 1.0])
)
def test_the_whole_cube_comes_back_and_the_scene_lies_inside(top, chroma, shrink):
    rgb = scene(top, chroma)
    space = fit(torch.cat([torch.zeros(500, 3), rgb]), shrink=shrink)
    dark = 0.01 * CUBE
    for colors in (CUBE, dark, rgb):
        torch.testing.assert_close(space.decode(space.encode(colors)), colors, atol=1e-6, rtol=0)
    assert torch.equal(space.decode(space.encode(torch.zeros(1, 3))), torch.zeros(1, 3))
    low, high = space.encode(torch.cat([rgb, torch.zeros(1, 3)])).quantile(torch.tensor([0.0005, 0.9995]), dim=0)
    assert (low >= 0.05 - 1e-3).all()
    assert (high <= 0.95 + 1e-3).all()


@pytest.mark.parametrize("shrink", [0.01, 0.1, 1.0])
def test_it_agrees_with_numpy(shrink):
    rgb = scene()
    space = fit(rgb, shrink=shrink)
    colors = rgb.double().numpy()
    values, vectors = np.linalg.eigh(np.cov(colors.T, bias=True))
    seen = colors @ vectors @ np.diag((values + shrink * values.max()) ** -0.5) @ vectors.T
    low, high = np.quantile(seen, [0.0005, 0.9995], axis=0)
    low = np.minimum(low, 0)
    expected = 0.05 + 0.9 * (seen - low) / (np.maximum(high, 0) - low)
    np.testing.assert_allclose(space.encode(rgb.double()), expected, atol=2e-6)


def test_chroma_is_raised_towards_luminance_and_no_further():
    rgb = scene(chroma=0.05)
    before = torch.linalg.eigvalsh(torch.cov(rgb.T))
    after = torch.linalg.eigvalsh(torch.cov(fit(rgb, shrink=0.1).encode(rgb).T))
    assert before[-1] / before[0] > 1000
    # (v / (v + s m)) / (m / (m + s m)) of the smallest v, at s = 0.1; the channels' scales are nearly one.
    small = before[0] / before[-1]
    assert float(after[0] / after[-1]) == pytest.approx(float(small / (small + 0.1) * 1.1), rel=0.1)


def test_what_cannot_be_a_colour_is_clipped():
    decoded = fit(scene()).decode(CUBE)
    assert decoded.min() == 0
    assert decoded.max() <= 1
    assert (decoded == 0).any(-1).any()


@pytest.mark.parametrize(
    "color", [[0.02, 0.02, 0.0], [0.5, 0.5, 0.5], [0.0, 0.0, 0.004]], ids=["no blue", "grey", "blue"]
)
def test_one_colour_and_channels_without_variation(color):
    space, rgb = Space(), torch.tensor([color]).expand(100, -1)
    latent = fitted(space, rgb)
    assert latent.min() >= 0.05
    assert latent.max() <= 0.9501
    torch.testing.assert_close(space.decode(latent), rgb, atol=1e-6, rtol=0)
    torch.testing.assert_close(space.decode(space.encode(CUBE)), CUBE, atol=1e-6, rtol=0)
    assert space.matrix.abs().max() < 1e4


def test_gradients_are_the_matrices():
    space = fit(scene())
    ends = torch.tensor([[0.0] * 3, [1.0] * 3], dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(space.encode, ends[0])
    torch.testing.assert_close(jacobian, space.matrix.double())
    latent = space.encode(torch.full((3,), 0.05, dtype=torch.float64))
    inverse = torch.autograd.functional.jacobian(space.decode, latent)
    torch.testing.assert_close(inverse @ jacobian, torch.eye(3).double())
