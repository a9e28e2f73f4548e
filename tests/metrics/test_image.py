import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import peak_signal_noise_ratio as torchmetrics_psnr

from ctm_plugin.metrics.image import best_constant_psnr, converged, psnr, ssim


def pair(seed: int = 0, shape: tuple[int, ...] = (3, 24, 31, 3), noise: float = 0.1, level: float = 1.0):
    generator = torch.Generator().manual_seed(seed)
    target = level * torch.rand(shape, generator=generator)
    return (target + level * noise * torch.randn(shape, generator=generator)).clamp(0, 1), target


@pytest.mark.parametrize("level", [1.0, 0.02])
def test_psnr_agrees_with_scikit_image_and_torchmetrics(level):
    prediction, target = pair(level=level)
    scores = psnr(prediction, target)
    expected = [
        peak_signal_noise_ratio(t, p, data_range=1.0)
        for p, t in zip(prediction.double().numpy(), target.double().numpy(), strict=True)
    ]
    np.testing.assert_allclose(scores, expected, rtol=1e-12)
    theirs = torchmetrics_psnr(prediction, target, data_range=1.0, reduction="none", dim=(1, 2, 3))
    np.testing.assert_allclose(scores, theirs, rtol=1e-5)


def test_psnr_is_per_image_not_pooled():
    target = torch.zeros(2, 4, 4, 3)
    prediction = torch.stack([torch.full((4, 4, 3), 0.1), torch.full((4, 4, 3), 0.01)])
    np.testing.assert_allclose(psnr(prediction, target), [20.0, 40.0], rtol=1e-6)


def test_psnr_of_one_image_is_a_scalar_and_of_equal_images_infinite():
    image = torch.rand(5, 6, 3)
    assert psnr(image, image).shape == ()
    assert math.isinf(psnr(image, image))
    assert math.isnan(psnr(image * torch.nan, image))


@given(st.integers(0, 2**31), st.floats(0.001, 0.4))
def test_psnr_is_symmetric_and_falls_with_the_error(seed, step):
    prediction, target = pair(seed, shape=(6, 5, 3))
    # To the bit: a difference and its negative have one square, and the sums are of one shape.
    assert torch.equal(psnr(prediction, target), psnr(target, prediction))
    further = target + (1 + step) * (prediction - target)
    assert psnr(further, target) < psnr(prediction, target)


@pytest.mark.parametrize("level", [1.0, 0.02])
@pytest.mark.parametrize("shape", [(3, 24, 31, 3), (2, 11, 11, 3)])
def test_ssim_agrees_with_scikit_image(shape, level):
    prediction, target = pair(shape=shape, level=level)
    expected = [
        structural_similarity(
            p,
            t,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            win_size=11,
            data_range=1.0,
            channel_axis=-1,
        )
        for p, t in zip(prediction.double().numpy(), target.double().numpy(), strict=True)
    ]
    np.testing.assert_allclose(ssim(prediction, target), expected, atol=2e-6)


def test_ssim_of_equal_images_is_one():
    image = torch.rand(12, 14, 3)
    assert ssim(image, image).shape == ()
    assert float(ssim(image, image)) == pytest.approx(1.0, abs=1e-6)


def test_ssim_does_not_depend_on_the_precision_of_the_run():
    prediction, target = pair(shape=(16, 16, 3))
    outside = ssim(prediction, target)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(ssim(prediction, target), outside)


@given(st.integers(0, 2**31))
def test_no_constant_colour_has_less_error_than_the_mean(seed):
    _, targets = pair(seed, shape=(3, 5, 4, 3))
    mean = targets.double().mean(dim=(0, 1, 2))
    expected = [10 * math.log10(1 / float((t.double() - mean).square().mean())) for t in targets]
    assert best_constant_psnr(targets) == pytest.approx(np.mean(expected), rel=1e-9)
    other = torch.rand(3, generator=torch.Generator().manual_seed(seed + 1))
    assert (targets - mean).square().mean() <= (targets - other).square().mean()


@pytest.mark.parametrize(
    ("value", "constant", "expected"),
    [
        (21.0, 20.0, True),
        (20.99, 20.0, False),
        (math.nan, 20.0, False),
        (math.inf, 20.0, True),
        (40.0, math.inf, False),
        (math.inf, math.inf, False),
    ],
)
def test_converged_wants_one_decibel_more_than_the_constant(value, constant, expected):
    assert converged(value, constant) is expected
