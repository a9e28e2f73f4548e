import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb

from ctm_plugin.color.srgb import enhancement_gain, lift
from ctm_plugin.errors import ConfigError


def images(seed: int = 0, level: float = 1.0, shape: tuple[int, ...] = (2, 9, 8, 3)):
    return level * torch.rand(shape, generator=torch.Generator().manual_seed(seed))


@given(st.integers(0, 2**31), st.floats(0.05, 200.0))
def test_lift_agrees_with_kornia(seed, gain):
    image = images(seed, shape=(6, 5, 3))
    planes = image.permute(2, 0, 1).double()
    expected = linear_rgb_to_rgb((rgb_to_linear_rgb(planes) * gain).clamp(0, 1)).permute(1, 2, 0)
    np.testing.assert_allclose(lift(image, gain), expected, atol=1e-5)


def test_lift_by_one_changes_nothing_and_lifts_undo_each_other():
    image = images()
    np.testing.assert_allclose(lift(image, 1.0), image, atol=1e-5)
    np.testing.assert_allclose(lift(lift(image, 0.02), 50.0), image, atol=1e-4)


def test_gain_is_the_inverse_of_a_known_exposure():
    assert enhancement_gain(images(), 0.02) == 50.0
    assert enhancement_gain(images(), 2.0) == 0.5


@pytest.mark.parametrize("exposure", [None, 1.0])
def test_gain_brings_the_99th_percentile_of_the_whole_set_to_white(exposure):
    targets = images(level=0.2, shape=(4, 20, 25, 3))
    gain = enhancement_gain(targets, exposure)
    lifted = lift(targets, gain).flatten()
    assert float((lifted > 1 - 1e-4).double().mean()) == pytest.approx(0.01, abs=0.001)
    assert enhancement_gain(list(targets), exposure) == gain


def test_gain_of_a_bright_set_is_about_one():
    assert enhancement_gain(torch.ones(1, 4, 4, 3), None) == pytest.approx(1.0, abs=1e-6)


def test_gain_of_a_black_set_is_one():
    assert enhancement_gain(torch.zeros(1, 4, 4, 3), None) == 1.0


@pytest.mark.parametrize("exposure", [0.0, -1.0, math.nan, math.inf])
def test_gain_refuses_an_exposure_that_is_not_positive(exposure):
    with pytest.raises(ConfigError, match="exposure: found"):
        enhancement_gain(images(), exposure)
