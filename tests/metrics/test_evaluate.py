import json

import numpy as np
import pytest
import torch

from ctm_plugin.color.light import brighten
from ctm_plugin.metrics.evaluate import summarize, summarize_alignment
from ctm_plugin.metrics.image import best_constant_psnr, psnr, ssim
from ctm_plugin.metrics.lpips import LPIPS
from ctm_plugin.metrics.rendered import Alignment

NAMES = ("r_0", "r_1", "r_2")
KEYS = {
    "psnr", "ssim", "lpips", "lpips_net", "lpips_reason", "psnr_enhanced", "enhancement_gain", "psnr_fitted", "detail",
    "depth_mae", "converged", "constant_psnr", "per_image",
}  # fmt: skip


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    return LPIPS("alex")


def pair(size: int = 32, level: float = 1.0):
    generator = torch.Generator().manual_seed(3)
    targets = level * torch.rand(3, size, size + 1, 3, generator=generator)
    return (targets + 0.05 * level * torch.randn(targets.shape, generator=generator)).clamp(0, 1), targets


def strict(summary: dict) -> str:
    return json.dumps(summary, allow_nan=False)


def test_scores_are_means_of_the_per_image_scores(model):
    predictions, targets = pair(level=0.1)
    summary = summarize(NAMES, predictions, targets, 0.02, lpips=(model, ""))
    assert set(summary) == KEYS
    assert [row["name"] for row in summary["per_image"]] == list(NAMES)
    expected = {
        "psnr": psnr(predictions, targets),
        "ssim": ssim(predictions, targets),
        "lpips": model(predictions, targets),
        "psnr_enhanced": psnr(brighten(predictions, 50.0, "hard"), brighten(targets, 50.0, "hard")),
    }
    for key, values in expected.items():
        np.testing.assert_allclose([row[key] for row in summary["per_image"]], values, rtol=1e-4)
        assert summary[key] == pytest.approx(np.mean([row[key] for row in summary["per_image"]]), rel=1e-12)
    assert summary["enhancement_gain"] == 50.0
    assert summary["constant_psnr"] == best_constant_psnr(targets)
    assert summary["converged"] is True
    assert (summary["lpips_net"], summary["lpips_reason"]) == ("alex", None)
    assert summary["depth_mae"] is None
    strict(summary)


def test_twice_the_same_to_the_last_digit_and_lists_equal_tensors(model):
    predictions, targets = pair()
    first = strict(summarize(NAMES, predictions, targets, None, lpips=(model, "")))
    assert strict(summarize(NAMES, predictions, targets, None, lpips=(model, ""))) == first
    assert strict(summarize(NAMES, list(predictions), list(targets), None, lpips=(model, ""))) == first


def test_depth_is_pooled_over_the_pixels_that_show_a_surface():
    predictions, targets = pair(size=11)
    true = torch.full(targets.shape[:3], torch.nan)
    true[0], true[1, 0, 0] = 2.0, 3.0
    depths = torch.full(targets.shape[:3], 2.5)
    summary = summarize(NAMES, predictions, targets, None, depths, true)
    assert [row["depth_mae"] for row in summary["per_image"]] == [0.5, 0.5, None]
    assert summary["depth_mae"] == 0.5
    depths[0] = 2.0
    summary = summarize(NAMES, predictions, targets, None, depths, true)
    assert summary["depth_mae"] == pytest.approx(0.5 / (11 * 12 + 1))
    strict(summary)


def test_depth_where_no_pixel_counts_is_left_out():
    predictions, targets = pair(size=11)
    true, depths = torch.ones(targets.shape[:3]), torch.ones(targets.shape[:3])
    depths[:, :, 0] = 9.0
    masks = torch.ones_like(depths, dtype=torch.bool)
    assert summarize(NAMES, predictions, targets, None, depths, true, masks=list(masks))["depth_mae"] > 0.5
    masks[:, :, 0] = False
    summary = summarize(NAMES, predictions, targets, None, depths, true, masks=list(masks))
    assert summary["depth_mae"] == summary["per_image"][1]["depth_mae"] == 0.0


def test_small_images_have_no_ssim_and_no_lpips_but_a_reason(model):
    predictions, targets = pair(size=10)
    summary = summarize(NAMES, predictions, targets, None, lpips=(model, ""))
    assert summary["ssim"] is summary["lpips"] is summary["lpips_net"] is summary["per_image"][0]["ssim"] is None
    assert summary["lpips_reason"] == "images of 10x11 pixels are smaller than LPIPS' 31"
    assert summary["psnr"] > 0


def test_nan_is_written_as_none_and_not_converged(model):
    predictions, targets = pair()
    predictions[1, 0, 0] = torch.nan
    summary = summarize(NAMES, predictions, targets, None, lpips=(model, ""))
    assert summary["psnr"] is summary["ssim"] is summary["psnr_enhanced"] is None
    assert summary["per_image"][1]["psnr"] is None
    assert summary["per_image"][0]["psnr"] > 0
    assert summary["converged"] is False
    strict(summary)


def test_exact_predictions_converge_with_an_infinite_psnr():
    _, targets = pair(size=11)
    summary = summarize(NAMES, targets.clone(), targets, None)
    assert summary["psnr"] is None
    assert summary["converged"] is True
    strict(summary)


def test_an_alignment_by_hand():
    # Patches off by 0.1 and by 0.01: 20 and 40 dB. Half of the picture is off by 0.1 as well.
    clean, picture = torch.rand(2, 6, 6, 3) * 0.5, torch.rand(12, 12, 3) * 0.5
    rendered = clean + torch.tensor([0.1, 0.01]).view(2, 1, 1, 1)
    fused = picture + 0.1
    fused[6:] += 0.3
    warps = torch.zeros(2, 8)
    warps[1, :2] = torch.tensor([0.3, 0.4])
    found = summarize_alignment(Alignment(rendered, clean, fused, picture, warps, torch.zeros(2, 8), 4.0))
    assert found["psnr"] == pytest.approx(30.0, abs=1e-3)
    assert [row["psnr"] for row in found["per_patch"]] == pytest.approx([20.0, 40.0], abs=1e-3)
    assert found["patch_psnr_pooled"] == pytest.approx(-10 * np.log10((0.01 + 0.0001) / 2), abs=1e-3)
    assert found["image_psnr"] == pytest.approx(-10 * np.log10((0.01 + 0.16) / 2), abs=1e-3)
    assert [row["warp_error"] for row in found["per_patch"]] == pytest.approx([0.0, 0.5])
    assert found["warp_error"] == pytest.approx(0.25)
    assert found["corner_error"] == pytest.approx(np.mean([row["corner_error"] for row in found["per_patch"]]))
    assert found["per_patch"][0]["corner_error"] == pytest.approx(0.0, abs=1e-4)
    assert found["enhancement_gain"] == 4.0
    assert found["converged"] is True
    strict(found)


@pytest.mark.parametrize("depths", [None, "given"])
def test_depth_needs_both_sides(depths):
    predictions, targets = pair(size=11)
    true = torch.ones(targets.shape[:3])
    one_sided = (None, true) if depths is None else (true, None)
    summary = summarize(NAMES, predictions, targets, None, *one_sided)
    assert summary["depth_mae"] is summary["per_image"][0]["depth_mae"] is None
