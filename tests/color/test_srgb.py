"""The sRGB curve against skimage, known points and its own laws."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from skimage import color

from ctm_plugin.color.srgb import linear_to_srgb, srgb_slope, srgb_to_linear

LEVELS = torch.arange(256, dtype=torch.float64) / 255.0


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
    light = tensor(linear).requires_grad_()
    linear_to_srgb(light).backward()
    assert srgb_slope(srgb) == pytest.approx(light.grad.item(), rel=1e-6)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_there_and_back_in_order(first, second):
    """The standard's two thresholds do not match exactly: around them the two branches differ by 1e-8."""
    low, high = tensor(min(first, second)), tensor(max(first, second))
    for curve, inverse in ((srgb_to_linear, linear_to_srgb), (linear_to_srgb, srgb_to_linear)):
        assert inverse(curve(low)).item() == pytest.approx(low.item(), abs=2e-7)
        assert (curve(high) - curve(low)).item() >= -2e-7
        assert 0.0 <= curve(low).item() <= 1.0


def test_8_bits_stay_and_gradients_are_finite():
    levels = LEVELS.float()
    assert torch.equal((linear_to_srgb(srgb_to_linear(levels)) * 255).round(), (levels * 255).round())
    for curve in (srgb_to_linear, linear_to_srgb):
        assert (curve(levels).diff() > 0).all()
        value = torch.tensor([0.0, 1e-8, 0.5, 1.0], requires_grad=True)
        (gradient,) = torch.autograd.grad(curve(value).sum(), value)
        assert gradient.isfinite().all()
