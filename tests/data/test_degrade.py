"""Exposure and noise against skimage, closed forms and their own laws."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from skimage import color

from ctm_plugin.data.degrade import NoiseConfig, add_noise, dim, linear_to_srgb, srgb_to_linear, view_generator
from ctm_plugin.errors import ConfigError

LEVELS = torch.arange(256, dtype=torch.float64) / 255.0
UNIT = st.floats(0.0, 1.0)
EXPOSURE = st.floats(1e-4, 1.0)


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


@given(UNIT, EXPOSURE)
def test_dim_matches_float64_formula(value, exposure):
    linear = value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4
    linear *= exposure
    expected = 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055
    assert dim(tensor(value), exposure).item() == pytest.approx(expected, abs=1e-12 if exposure < 1 else 1e-7)
    assert dim(tensor(value).float(), exposure).item() == pytest.approx(expected, abs=1e-6)


@given(UNIT, EXPOSURE, EXPOSURE)
def test_dimming_twice_multiplies(value, a, b):
    assert dim(dim(tensor(value), a), b).item() == pytest.approx(dim(tensor(value), a * b).item(), abs=1e-6)


@given(UNIT, EXPOSURE, EXPOSURE)
def test_dim_is_monotonic_in_the_exposure(value, a, b):
    assert dim(tensor(value), min(a, b)).item() <= dim(tensor(value), max(a, b)).item() + 2e-7
    assert dim(tensor(value), a).item() <= value + 2e-7


def test_exposure_one_is_the_identity_bit_for_bit():
    levels = LEVELS.float()
    assert torch.equal(dim(levels, 1.0), levels)
    assert torch.equal((linear_to_srgb(srgb_to_linear(levels)) * 255).round(), (levels * 255).round())


def test_noise_variance_in_linear_light():
    noise = NoiseConfig(read=0.01, shot=0.002, seed=3)
    image = torch.full((200_000,), 0.6, dtype=torch.float64)
    light = srgb_to_linear(image)
    noisy = srgb_to_linear(add_noise(image, noise, view_generator(0, "a")))
    assert noisy.mean().item() == pytest.approx(light[0].item(), abs=3e-4)
    assert noisy.var().item() == pytest.approx((0.002 * light[0] + 0.01**2).item(), rel=0.02)


def test_noise_stays_in_range_and_off_is_the_identity():
    image = LEVELS.float()
    noisy = add_noise(image, NoiseConfig(read=1.0, shot=1.0), view_generator(0, "a"))
    assert noisy.min() >= 0.0
    assert noisy.max() <= 1.0
    assert add_noise(image, NoiseConfig(seed=5), view_generator(5, "a")) is image


def test_generators_depend_on_seed_and_name_alone():
    def draw(seed: int, name: str) -> torch.Tensor:
        return torch.randn(4, generator=view_generator(seed, name))

    assert torch.equal(draw(0, "r_1"), draw(0, "r_1"))
    assert not torch.equal(draw(0, "r_1"), draw(0, "r_2"))
    assert not torch.equal(draw(0, "r_1"), draw(1, "r_1"))


@pytest.mark.parametrize("key", ["read", "shot"])
@pytest.mark.parametrize("value", [-0.1, 1.1, float("nan"), float("inf")])
def test_bad_noise_is_refused(key, value):
    with pytest.raises(ConfigError, match=rf"dataset\.noise\.{key}: found .*, expected a number from 0 to 1"):
        NoiseConfig(**{key: value})


def test_bad_noise_seed_is_refused():
    with pytest.raises(ConfigError, match=r"dataset\.noise\.seed: found -1"):
        NoiseConfig(seed=-1)
