"""Detail: closed forms of noise, blur and displacement, and what leaves the number alone."""

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d

from ctm_plugin.metrics.detail import detail, detail_moments
from ctm_plugin.metrics.evaluate import summarize
from ctm_plugin.metrics.image import SSIM_SIGMA, SSIM_WINDOW

HEIGHT, WIDTH = 180, 240


@pytest.fixture(scope="module")
def clean() -> torch.Tensor:
    """Textured patches on smooth ground, a third of each brightness flat."""
    random = torch.Generator().manual_seed(3)
    texture = torch.randn(HEIGHT, WIDTH, 3, generator=random).mean(-1)
    texture = blurred(texture, 0.7)
    where = (torch.arange(HEIGHT) // 30 % 3 > 0).float()[:, None]
    return grey(0.3 + 0.3 * torch.linspace(0, 1, WIDTH) + 0.1 * where * texture / texture.std())


def grey(values: torch.Tensor) -> torch.Tensor:
    return values[..., None].expand(-1, -1, 3).float().clamp(0, 1)


def weights(sigma: float) -> np.ndarray:
    at = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    found = np.exp(-0.5 * (at / sigma) ** 2)
    return found / found.sum()


def blurred(values: torch.Tensor, sigma: float) -> torch.Tensor:
    window = weights(sigma)
    return torch.from_numpy(correlate1d(correlate1d(values.double().numpy(), window, 0), window, 1)).float()


def noisy(image: torch.Tensor, deviation: float) -> torch.Tensor:
    """Photon noise: in the bright half it has twice the deviation of the dark one."""
    steps = torch.linspace(1, 2, WIDTH)[None, :, None] * deviation
    noise = torch.randn(image.shape[:2], generator=torch.Generator().manual_seed(1))[..., None]
    return image + steps * noise


def score(rendered: torch.Tensor, photograph: torch.Tensor) -> float:
    return detail([detail_moments(rendered, photograph)])


@pytest.mark.parametrize(("deviation", "within"), [(0.0, 0.01), (0.02, 0.05), (0.05, 0.08), (0.1, 0.15)])
def test_noise_of_the_photograph_takes_nothing(clean, deviation, within):
    assert score(clean, noisy(clean, deviation)) == pytest.approx(1, abs=within)


def test_without_noise_it_is_the_squared_correlation_of_the_bands(clean):
    rendered = grey(blurred(clean[..., 0], 1.0))
    edge = SSIM_WINDOW // 2
    bands = [
        (each[..., 0] - blurred(each[..., 0], SSIM_SIGMA))[edge:-edge, edge:-edge].double()
        for each in (rendered, clean)
    ]
    expected = (bands[0] * bands[1]).mean() ** 2 / (bands[0].square().mean() * bands[1].square().mean())
    assert score(rendered, clean) == pytest.approx(float(expected), abs=0.02)


def test_worse_views_show_less(clean):
    photograph = noisy(clean, 0.03)
    found = [
        score(each, photograph) for each in (clean, grey(blurred(clean[..., 0], 1)), grey(blurred(clean[..., 0], 3)))
    ]
    assert found == sorted(found, reverse=True)
    assert found[1] < 0.8
    assert found[2] < 0.3
    shifted = [score(clean.roll(by, 0), photograph) for by in (0, 1, 2)]
    assert shifted == sorted(shifted, reverse=True)
    assert shifted[2] < 0.1
    invented = clean + 0.1 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(8))
    assert score(invented, photograph) < 0.7


def test_another_picture_and_none_at_all(clean):
    photograph = noisy(clean, 0.03)
    assert score(clean.flip(0, 1), photograph) < 0.02
    assert score(1 - clean, photograph) == 0
    assert score(torch.full_like(clean, 0.4), photograph) == 0
    assert score(clean, torch.full_like(clean, 0.4)) is None


def test_a_factor_changes_nothing(clean):
    rendered, photograph = 0.8 * grey(blurred(clean[..., 0], 0.8)), noisy(clean, 0.03)
    expected = score(rendered, photograph)
    assert score(0.3 * rendered, photograph) == pytest.approx(expected, rel=1e-3)
    assert score(rendered, 0.3 * photograph + 0.1) == pytest.approx(expected, rel=1e-3)


def test_what_a_mask_takes_out_does_not_count(clean):
    photograph, mask = noisy(clean, 0.03), torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, 232:] = False
    spoilt = torch.where(mask[..., None], clean, torch.rand(clean.shape, generator=torch.Generator().manual_seed(4)))
    one, other = (detail_moments(each, photograph, mask) for each in (clean, spoilt))
    assert torch.equal(one, other)
    torch.testing.assert_close(one[:3], detail_moments(clean[:, :232], photograph[:, :232])[:3], rtol=1e-4, atol=0)


@pytest.mark.parametrize(("rows", "told"), [(11, False), (12 * 13, False), (12 * 14, True)])
def test_views_of_few_squares_tell_nothing(clean, rows, told):
    """Squares of 12 pixels, 19 side by side; 250 are wanted."""
    view = clean[: SSIM_WINDOW - 1 + rows]
    assert (detail_moments(view, view) is not None) == told


def test_nothing_is_told_where_the_photograph_is_all_noise_or_flat():
    assert detail([torch.tensor([0.5, 1.0, 1.0, 0.5]).double()]) == pytest.approx(0.5)
    assert detail([torch.tensor([0.5, 1.0, 1.0, 0.96]).double()]) is None
    assert detail([torch.zeros(4).double()]) is None
    assert detail([]) is None


def test_views_are_added_before_they_are_divided(clean):
    shown, photographs = [clean, clean.roll(2, 0)], [noisy(clean, 0.03), 0.5 * clean]
    views = [detail_moments(*pair) for pair in zip(shown, photographs, strict=True)]
    small = [each[::10, ::10] for each in shown]
    found = summarize(["a", "b", "c"], [*small, small[0]], [*small, None], None, details=[*views, None])
    assert found["detail"] == detail(views)
    assert [row["detail"] for row in found["per_image"]] == [detail([view]) for view in views] + [None]
    assert found["detail"] != pytest.approx(sum(detail([view]) for view in views) / 2, abs=0.1)
    assert summarize(["a"], small[:1], small[:1], None)["detail"] is None
