"""Fitted on the left half, scored on the right one."""

import pytest
import torch

from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.metrics.fitted import fit_light, psnr_fitted
from ctm_plugin.metrics.image import psnr

MATRIX = torch.tensor([[0.5, 0.02, 0.0], [0.05, 0.4, 0.01], [0.0, 0.03, 0.3]], dtype=torch.float64)


@pytest.fixture
def picture() -> torch.Tensor:
    return torch.rand(12, 16, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_another_exposure_and_white_balance_are_found(picture):
    shown = linear_to_srgb(srgb_to_linear(picture) @ MATRIX)
    torch.testing.assert_close(fit_light(picture.flatten(0, 1), shown.flatten(0, 1)), MATRIX, atol=1e-9, rtol=0)
    assert psnr_fitted(picture, shown) > 150
    assert float(psnr(picture, shown)) < 15


def test_the_right_half_has_no_part_in_the_fit(picture):
    """What is scored there is as if nothing was fitted where the left halves agree."""
    target = picture.clone()
    target[:, 8:] = 0.7 * picture[:, 8:]
    assert psnr_fitted(picture, target) == pytest.approx(float(psnr(picture[:, 8:], target[:, 8:])), abs=1e-6)


def test_the_best_fit_is_of_srgb_not_of_light(picture):
    """With noise: no small change of the matrix makes the error of sRGB smaller."""
    noise = 0.004 * torch.randn(picture.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    shown = (linear_to_srgb(srgb_to_linear(picture) @ MATRIX) + noise).clamp(0, 1).flatten(0, 1)
    light = srgb_to_linear(picture).flatten(0, 1)

    def error(matrix: torch.Tensor) -> float:
        return float((linear_to_srgb((light @ matrix).clamp(0, 1)) - shown).square().mean())

    found = fit_light(picture.flatten(0, 1), shown)
    assert error(found) < 1.01 * min(error(found + sign * 0.02 * torch.eye(3)) for sign in (-1, 1))
    plain = torch.linalg.lstsq(light, srgb_to_linear(shown)).solution
    assert error(found) < 1.02 * error(plain)


def test_a_least_squares_problem_a_column_weighed_by_the_curves_slope(picture):
    """By torch's solver and autograd, where the target is no image of the prediction."""
    prediction, target = picture.flatten(0, 1), picture.flip(0).flatten(0, 1)
    light = srgb_to_linear(target).requires_grad_()
    (slopes,) = torch.autograd.grad(linear_to_srgb(light).sum(), light)
    rows, light = srgb_to_linear(prediction), light.detach()
    columns = zip(light.T, slopes.T, strict=True)
    expected = [torch.linalg.lstsq(rows * slope[:, None], (y * slope)[:, None]).solution for y, slope in columns]
    torch.testing.assert_close(fit_light(prediction, target), torch.cat(expected, dim=1), rtol=1e-8, atol=1e-10)


def test_masks(picture):
    target = 0.8 * picture
    target[0, 0] = 1.0
    mask = torch.ones(12, 16, dtype=torch.bool)
    mask[0, 0] = False
    whole = picture.clone()
    whole[0, 0] = 0.3
    clean = target.clone()
    clean[0, 0] = 0.24
    assert psnr_fitted(picture, target, mask) == pytest.approx(psnr_fitted(whole, clean, mask))
    mask[:, :8] = False
    assert psnr_fitted(picture, target, mask) is None
    assert psnr_fitted(picture[:, :1], target[:, :1]) is None


def test_a_black_rendering_has_a_score(picture):
    assert psnr_fitted(torch.zeros_like(picture), picture) == pytest.approx(
        float(psnr(0 * picture[:, 8:], picture[:, 8:]))
    )
