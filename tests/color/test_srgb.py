"""The sRGB curve against skimage, known points and its own laws."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from skimage import color

from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear

LEVELS = torch.arange(256, dtype=torch.float64) / 255.0
UNIT = st.floats(0.0, 1.0)


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_curves_match_skimage():
    grey = LEVELS.numpy()[:, None, None].repeat(3, axis=2)
    linear = color.rgb2xyz(grey) @ np.linalg.inv(color.colorconv.xyz_from_rgb).T
    np.testing.assert_allclose(srgb_to_linear(torch.from_numpy(grey)), linear, atol=1e-12)
    # skimage's own two matrices invert each other to 1e-6 only.
    np.testing.assert_allclose(linear_to_srgb(torch.from_numpy(linear)), color.xyz2rgb(color.rgb2xyz(grey)), atol=1e-5)


@pytest.mark.parametrize(("srgb", "linear"), [(0.0, 0.0), (0.04, 0.04 / 12.92), (0.5, 0.21404114048), (1.0, 1.0)])
def test_curves_at_known_points(srgb, linear):
    assert srgb_to_linear(tensor(srgb)).item() == pytest.approx(linear, abs=1e-10)
    assert linear_to_srgb(tensor(linear)).item() == pytest.approx(srgb, abs=1e-8)


@given(UNIT)
def test_round_trip(value):
    # The standard's two thresholds do not match exactly: around them the two branches differ by 1e-8.
    assert linear_to_srgb(srgb_to_linear(tensor(value))).item() == pytest.approx(value, abs=2e-7)
    assert srgb_to_linear(linear_to_srgb(tensor(value))).item() == pytest.approx(value, abs=2e-7)


@given(UNIT, UNIT)
def test_curves_are_monotonic_up_to_the_joint(a, b):
    low, high = tensor(min(a, b)), tensor(max(a, b))
    for curve in (srgb_to_linear, linear_to_srgb):
        assert (curve(high) - curve(low)).item() >= -2e-7
        assert 0.0 <= curve(low).item() <= 1.0


def test_curves_are_monotonic_on_8_bits():
    assert (srgb_to_linear(LEVELS.float()).diff() > 0).all()
    assert (linear_to_srgb(LEVELS.float()).diff() > 0).all()


def test_curves_have_finite_gradients_at_black():
    for curve in (srgb_to_linear, linear_to_srgb):
        value = torch.tensor([0.0, 1e-8, 0.5, 1.0], requires_grad=True)
        (gradient,) = torch.autograd.grad(curve(value).sum(), value)
        assert gradient.isfinite().all()


def test_there_and_back_8_bits_stay():
    levels = LEVELS.float()
    assert torch.equal((linear_to_srgb(srgb_to_linear(levels)) * 255).round(), (levels * 255).round())
