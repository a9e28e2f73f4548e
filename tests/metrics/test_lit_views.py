"""Lit views: the oracle of colours, and what is scored of whom."""

import numpy as np
import pytest
import torch

from ctm_plugin.color.light import Light, brighten
from ctm_plugin.metrics.evaluate import summarize
from ctm_plugin.metrics.fitted import fit_colors, lit_views, map_colors
from ctm_plugin.metrics.image import best_constant_psnr, psnr, ssim
from ctm_plugin.metrics.lpips import LPIPS

NAMES = ("a", "b", "c")
LIGHT = Light(9.0)


@pytest.fixture
def scene():
    generator = torch.Generator().manual_seed(5)
    references = torch.rand(3, 32, 33, 3, generator=generator)
    targets = 0.3 * references
    predictions = (targets + 0.02 * torch.randn(targets.shape, generator=generator)).clamp(0, 1)
    masks = torch.ones(3, 32, 33, dtype=torch.bool)
    masks[:, :4] = False
    masks[1, 20, 20] = False
    return predictions, targets, references, masks


def test_a_colour_map_is_found_again():
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(2, 9, 8, 3, generator=generator)
    colors = torch.tensor([[0.5, 0.1, 0], [0, 0.4, 0.1], [0.1, 0, 0.5], [0.05, 0.1, 0.15]], dtype=torch.float64)
    references = [map_colors(image, colors) for image in images]
    torch.testing.assert_close(fit_colors(list(images), references, [None, None]), colors, atol=1e-6, rtol=0)


def test_the_fit_is_least_squares_over_the_pixels_that_count(scene):
    images, _, references, masks = scene
    rows = np.concatenate([image[mask].double().numpy() for image, mask in zip(images, masks, strict=True)])
    rows = np.column_stack([rows, np.ones(len(rows))])
    wanted = np.concatenate([image[mask].double().numpy() for image, mask in zip(references, masks, strict=True)])
    expected = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    np.testing.assert_allclose(fit_colors(list(images), list(references), list(masks)), expected, atol=1e-8)


def test_no_map_of_the_rendering_is_better_than_the_fitted_one(scene):
    predictions, targets, references, _ = scene
    views = lit_views(list(predictions), list(targets), list(references), [None] * 3, LIGHT)
    plain, fitted = (torch.stack([getattr(view, which) for view in views]) for which in ("rendered", "fitted"))
    assert (fitted - references).square().mean() <= (plain - references).square().mean()


def test_lit_scores_beside_the_dark_ones(scene):
    predictions, targets, references, _ = scene
    model = LPIPS("alex")
    alone = summarize(NAMES, predictions, targets, None, lpips=(model, ""))
    found = summarize(NAMES, predictions, targets, None, lpips=(model, ""), references=references, light=LIGHT)
    assert not any("lit" in key for key in alone)
    assert {key: found[key] for key in alone if key != "per_image"} == {
        key: value for key, value in alone.items() if key != "per_image"
    }
    lit, photo = LIGHT.apply(predictions), LIGHT.apply(targets)
    for suffix, image in (("", lit), ("_photo", photo)):
        assert found[f"psnr_lit{suffix}"] == pytest.approx(float(psnr(image, references).mean()))
        assert found[f"ssim_lit{suffix}"] == pytest.approx(float(ssim(image, references).mean()))
        assert found[f"lpips_lit{suffix}"] == pytest.approx(float(model(image, references).mean()))
    assert found["psnr_lit_fitted"] > found["psnr_lit"]
    assert found["per_image"][2]["psnr_lit"] == pytest.approx(float(psnr(lit[2], references[2])))


def test_what_a_mask_takes_out_moves_no_score(scene):
    predictions, targets, references, masks = scene
    model = LPIPS("alex")

    def scored(noise: float) -> dict:
        outside = torch.where(masks[..., None], 0.0, noise)
        given = [(each + outside).clamp(0, 1) for each in (predictions, targets, references)]
        options = {"lpips": (model, ""), "masks": list(masks), "light": LIGHT}
        return summarize(NAMES, given[0], given[1], 0.5, references=given[2], **options)

    first, second = scored(0.0), scored(0.7)
    lpips = {key for key in first if key.startswith("lpips")}  # its features look beyond a pixel, at the target there
    numbers = [key for key, value in first.items() if isinstance(value, float) and key not in lpips]
    assert {"psnr", "ssim", "psnr_enhanced", "psnr_lit", "ssim_lit_photo", "constant_psnr"} <= set(numbers)
    for key in numbers:
        assert second[key] == pytest.approx(first[key], abs=1e-5), key
    noisy = predictions.where(masks[..., None], 0.9)
    assert summarize(NAMES, noisy, targets, 0.5, lpips=(model, ""), masks=list(masks))["lpips"] == first["lpips"]


def test_masked_scores_by_hand(scene):
    predictions, targets, _, masks = scene
    found = summarize(NAMES, predictions, targets, 0.5, masks=list(masks))
    squares = [
        (p[m].double() - t[m].double()).square().mean() for p, t, m in zip(predictions, targets, masks, strict=True)
    ]
    assert found["psnr"] == pytest.approx(float(np.mean([-10 * np.log10(each) for each in squares])))
    whole = ssim(predictions[0, 4:], targets[0, 4:])  # what is left of the first view is a rectangle
    assert found["per_image"][0]["ssim"] == pytest.approx(float(whole), abs=1e-6)
    assert found["constant_psnr"] == best_constant_psnr(targets, list(masks))
    lifted = psnr(brighten(predictions, 2.0, "hard"), brighten(targets, 2.0, "hard"), masks)
    assert found["psnr_enhanced"] == pytest.approx(float(lifted.mean()))


def test_a_mask_without_room_for_a_window_or_a_pixel(scene):
    predictions, targets, _, _ = scene
    mask = torch.zeros(32, 33, dtype=torch.bool)
    assert psnr(predictions[0], targets[0], mask).isnan()
    mask[:10] = True
    assert ssim(predictions[0], targets[0], mask).isnan()
    assert summarize(NAMES, predictions, targets, None, masks=[mask] * 3)["ssim"] is None


def test_views_without_a_picture_are_not_scored(scene):
    predictions, targets, references, _ = scene
    found = summarize(NAMES, predictions, [targets[0], None, targets[2]], None)
    assert found["psnr"] == pytest.approx(float(psnr(predictions[[0, 2]], targets[[0, 2]]).mean()))
    assert found["constant_psnr"] == best_constant_psnr(targets[[0, 2]])
    assert found["per_image"][1]["psnr"] is None
    assert [row["name"] for row in found["per_image"]] == list(NAMES)
    found = summarize(NAMES, predictions, [None] * 3, None, references=references, light=LIGHT)
    for key in ("psnr", "ssim", "psnr_enhanced", "enhancement_gain", "converged", "constant_psnr", "psnr_lit_photo"):
        assert found[key] is None, key
    assert found["psnr_lit"] == pytest.approx(float(psnr(LIGHT.apply(predictions), references).mean()))


def test_pictures_of_one_colour_have_a_fit():
    grey = torch.full((4, 4, 3), 0.5)
    mapped = map_colors(grey, fit_colors([grey], [0.4 * grey], [None]))
    torch.testing.assert_close(mapped, 0.4 * grey)
