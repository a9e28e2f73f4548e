"""More light, and less: the curve, the factors that are found, and what is left as it is."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb

from ctm_plugin.color.light import (
    KNEE,
    LEAST,
    MEAN,
    auto_factor,
    brighten,
    enhancement_gain,
    factor_to_mean,
    histogram,
    shoulder,
)
from ctm_plugin.color.settings import factor_of
from ctm_plugin.errors import ConfigError
from ctm_plugin.metrics.image import psnr, psnr_enhanced

FACTORS = st.floats(1.0, 1000.0)


def floats(level: float = 1.0, seed: int = 0, shape: tuple[int, ...] = (2, 9, 8, 3)) -> torch.Tensor:
    return level * torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def pictures(level: float, seed: int = 0, channels: int = 3) -> torch.Tensor:
    return (255 * floats(level, seed, (3, 20, 24, channels))).round().byte()


@given(st.integers(0, 2**31), st.floats(1e-4, 200.0))
def test_without_a_shoulder_it_agrees_with_kornia(seed, factor):
    image = floats(seed=seed, shape=(6, 5, 3))
    planes = image.permute(2, 0, 1).double()
    expected = linear_rgb_to_rgb((rgb_to_linear_rgb(planes) * factor).clamp(0, 1)).permute(1, 2, 0)
    np.testing.assert_allclose(brighten(image, factor, "hard"), expected, atol=1e-5)


def test_light_taken_comes_back():
    np.testing.assert_allclose(brighten(brighten(floats(), 0.02, "hard"), 50.0, "hard"), floats(), atol=1e-4)


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
    np.testing.assert_allclose(shoulder(light, white).diff() / light.diff(), 1.0, atol=1e-4)


def test_one_is_the_limit_of_lamps():
    """Reinhard's curve without white is t / (1 + t)."""
    light = torch.tensor([1.0, 10.0, 1e5], dtype=torch.float64)
    t = (light - KNEE) / (1 - KNEE)
    np.testing.assert_allclose(shoulder(light, 1e12), KNEE + (1 - KNEE) * t / (1 + t), rtol=1e-6)


@pytest.mark.parametrize("clip", ["shoulder", "hard"])
@given(st.floats(1e-3, 1000.0), st.floats(1e-3, 1000.0))
def test_brighter_pictures_and_larger_factors_are_brighter(clip, first, second):
    image = torch.linspace(0, 1, 301, dtype=torch.float64)
    less, more = (brighten(image, factor, clip) for factor in sorted((first, second)))
    assert (less <= more + 1e-12).all()
    assert (more.diff() >= -2e-7).all()  # sRGB's two pieces meet so closely
    assert more[0] == 0
    assert max(first, second) < 1 or more[-1] == pytest.approx(1)


def test_one_changes_nothing_and_below_the_knee_light_is_multiplied():
    image = floats().double()
    np.testing.assert_allclose(brighten(image, 1.0), image, atol=1e-12)
    for part, factor in ((0.1, 20.0), (1.0, 0.25)):
        np.testing.assert_allclose(brighten(part * image, factor), brighten(part * image, factor, "hard"), atol=1e-12)


@given(st.floats(0.02, 0.5), st.integers(0, 1000))
def test_the_mean_of_the_training_pictures_is_reached(level, seed):
    images = pictures(level, seed)
    brightened = brighten(images.double() / 255, factor_to_mean(torch.arange(256) / 255, histogram(images)))
    assert float(brightened.mean()) == pytest.approx(MEAN, abs=1e-6)


def test_floats_have_the_factor_of_their_levels():
    images = pictures(0.1)
    assert auto_factor(images.float() / 255) == pytest.approx(auto_factor(images), rel=1e-3)
    assert auto_factor(images.flatten(0, 2)) == auto_factor(images)


def test_what_is_lit_stays_and_what_no_factor_brightens_ends_at_the_largest():
    nearly, one_pixel = pictures(0.85), torch.zeros(1, 10, 10, 3, dtype=torch.uint8)
    assert 1.0 < factor_to_mean(torch.arange(256) / 255, histogram(nearly)) < LEAST
    one_pixel[0, 0] = 40
    found = [auto_factor(each) for each in (pictures(1.0), nearly, 0 * one_pixel, one_pixel)]
    assert found == [1.0, 1.0, 1.0, 1024.0]


def test_transparent_and_masked_pixels_do_not_count():
    images = pictures(0.2, channels=4)
    images[..., 3] = 255
    mask = floats(shape=images.shape[:3]) > 0.5
    wanted = histogram(images[mask])
    behind, loud = images.clone(), images.clone()
    behind[~mask], loud[~mask] = 0, 255
    assert torch.equal(histogram(behind), wanted)
    assert torch.equal(histogram(loud, mask), wanted)
    assert wanted.sum() == 3 * mask.sum()


def test_settings():
    assert [factor_of(light, 30.0) for light in ("auto", "off", "3", -1.0, 0.0)] == [30.0, 1.0, 8.0, 0.5, 1.0]


@pytest.mark.parametrize("light", ["bright", "", "nan", "inf", "11", -10.5, math.nan])
def test_other_settings_are_refused(light):
    with pytest.raises(ConfigError, match=r"light: found .*, expected auto, off, or a number of stops"):
        factor_of(light, 1.0)


@pytest.mark.parametrize(
    ("targets", "exposure", "gain"),
    [
        (floats(), 0.02, 50.0), (floats(), 2.0, 0.5),
        (torch.ones(1, 4, 4, 3), None, pytest.approx(1.0, abs=1e-6)), (torch.zeros(1, 4, 4, 3), None, 1.0),
    ],
)  # fmt: skip
def test_gain_for_scores(targets, exposure, gain):
    """The inverse of an exposure that is known; about one for what is bright, or all black."""
    assert enhancement_gain(targets, exposure) == gain


@pytest.mark.parametrize("exposure", [None, 1.0])
def test_gain_brings_the_99th_percentile_of_the_whole_set_to_white(exposure):
    targets = floats(0.2, shape=(4, 20, 25, 3))
    gain = enhancement_gain(targets, exposure)
    white = brighten(targets, gain, "hard").flatten() > 1 - 1e-4
    assert float(white.double().mean()) == pytest.approx(0.01, abs=0.001)
    assert enhancement_gain(list(targets), exposure) == gain


@pytest.mark.parametrize("exposure", [0.0, -1.0, math.nan, math.inf])
def test_gain_refuses_an_exposure_that_is_not_positive(exposure):
    with pytest.raises(ConfigError, match="exposure: found"):
        enhancement_gain(floats(), exposure)


def test_psnr_enhanced_is_the_psnr_of_brightened_images():
    target = floats(0.1)
    prediction = (target + 0.01 * floats(seed=1)).clamp(0, 1)
    np.testing.assert_allclose(psnr_enhanced(prediction, target, 1.0), psnr(prediction, target), rtol=1e-4)
    brightened = psnr(*(brighten(each, 30.0, "hard") for each in (prediction, target)))
    np.testing.assert_allclose(psnr_enhanced(prediction, target, 30.0), brightened, rtol=1e-4)
    assert (brightened < psnr(prediction, target)).all()
