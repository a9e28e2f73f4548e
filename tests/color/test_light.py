"""Brightening: its curve, its factor, and what it leaves alone."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.color.light import KNEE, LEAST, MEAN, auto_factor, brighten, factor_to_mean, histogram, shoulder
from ctm_plugin.color.settings import factor_of
from ctm_plugin.color.srgb import lift
from ctm_plugin.errors import ConfigError

FACTORS = st.floats(1.0, 1000.0)


def pictures(level: float, seed: int = 0, channels: int = 3):
    generator = torch.Generator().manual_seed(seed)
    return (255 * level * torch.rand(3, 20, 24, channels, generator=generator)).round().byte()


@given(FACTORS)
def test_the_shoulder_bends_from_the_knee_to_white(white):
    light = torch.linspace(0, white, 5001, dtype=torch.float64)
    bent = shoulder(light, white)
    assert bent[0] == 0
    assert bent[-1] == pytest.approx(1.0, abs=1e-12)
    assert torch.equal(bent[light <= KNEE], light[light <= KNEE])
    assert (bent.diff() > 0).all()
    assert (bent <= light + 1e-12).all()


@pytest.mark.parametrize("white", [1.5, 20.0, 1000.0])
def test_value_and_slope_are_continuous_at_the_knee(white):
    light = torch.tensor([KNEE - 1e-6, KNEE, KNEE + 1e-6], dtype=torch.float64)
    slopes = shoulder(light, white).diff() / light.diff()
    np.testing.assert_allclose(slopes, 1.0, atol=1e-4)


def test_one_is_the_limit_of_lamps():
    """Reinhard's curve without white is t / (1 + t)."""
    light = torch.tensor([1.0, 10.0, 1e5], dtype=torch.float64)
    t = (light - KNEE) / (1 - KNEE)
    np.testing.assert_allclose(shoulder(light, 1e12), KNEE + (1 - KNEE) * t / (1 + t), rtol=1e-6)


@given(FACTORS, FACTORS)
def test_brighter_pictures_and_larger_factors_are_brighter(first, second):
    image = torch.linspace(0, 1, 301, dtype=torch.float64)
    less, more = (brighten(image, factor) for factor in sorted((first, second)))
    assert (less <= more + 1e-12).all()
    assert (more.diff() >= 0).all()
    assert (more[0], more[-1]) == (0, pytest.approx(1))


def test_one_changes_nothing_and_below_the_knee_light_is_multiplied():
    image = torch.rand(9, 8, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    np.testing.assert_allclose(brighten(image, 1.0), image, atol=1e-12)
    dark = 0.1 * image
    np.testing.assert_allclose(brighten(dark, 20.0), lift(dark, 20.0), atol=1e-12)
    np.testing.assert_allclose(brighten(image, 0.25), lift(image, 0.25), atol=1e-12)


@given(st.floats(0.02, 0.5), st.integers(0, 1000))
def test_the_mean_of_the_training_pictures_is_reached(level, seed):
    images = pictures(level, seed)
    brightened = brighten(images.double() / 255, factor_to_mean(torch.arange(256) / 255, histogram(images)))
    assert float(brightened.mean()) == pytest.approx(MEAN, abs=1e-6)


def test_floats_have_the_factor_of_their_levels():
    images = pictures(0.1)
    assert auto_factor(images.float() / 255) == pytest.approx(auto_factor(images), rel=1e-3)
    assert auto_factor(images.flatten(0, 2)) == auto_factor(images)


def test_lit_and_nearly_lit_pictures_are_left_alone():
    assert auto_factor(pictures(1.0)) == 1.0
    nearly = pictures(0.85)
    assert 1.0 < factor_to_mean(torch.arange(256) / 255, histogram(nearly)) < LEAST
    assert auto_factor(nearly) == 1.0
    assert auto_factor(torch.zeros(1, 4, 4, 3, dtype=torch.uint8)) == 1.0


def test_what_no_factor_brightens_ends_at_the_largest():
    images = torch.zeros(1, 10, 10, 3, dtype=torch.uint8)
    images[0, 0] = 40
    assert auto_factor(images) == 1024.0


def test_transparent_and_masked_pixels_do_not_count():
    images = pictures(0.2, channels=4)
    images[..., 3] = 255
    mask = torch.rand(images.shape[:3], generator=torch.Generator().manual_seed(0)) > 0.5
    wanted = histogram(images[mask])
    behind = images.clone()
    behind[~mask] = 0
    assert torch.equal(histogram(behind), wanted)
    loud = images.clone()
    loud[~mask] = 255
    assert torch.equal(histogram(loud, mask), wanted)
    assert wanted.sum() == 3 * mask.sum()


def test_settings():
    assert [factor_of(light, 30.0) for light in ("auto", "off", "3", -1.0, 0.0)] == [30.0, 1.0, 8.0, 0.5, 1.0]


@pytest.mark.parametrize("light", ["bright", "", "nan", "inf", "11", -10.5, math.nan])
def test_other_settings_are_refused(light):
    with pytest.raises(ConfigError, match=r"light: found .*, expected auto, off, or a number of stops"):
        factor_of(light, 1.0)
