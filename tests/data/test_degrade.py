"""Exposure and noise against closed forms and their own laws."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.color.srgb import srgb_to_linear
from ctm_plugin.data.degrade import NoiseConfig, add_noise, dim, view_generator

LEVELS = torch.arange(256, dtype=torch.float64) / 255.0
UNIT = st.floats(0.0, 1.0)
EXPOSURE = st.floats(1e-4, 1.0)


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


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


def test_exposure_one_is_the_identity_bit_for_bit():
    levels = LEVELS.float()
    assert torch.equal(dim(levels, 1.0), levels)


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
