"""Pixels of 8 bits and of more, and what masks take out."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.scene.views import Views, bright_level, composite, unit


def views(images: torch.Tensor, mask: torch.Tensor | None = None) -> Views:
    count = len(images)
    return Views(images, torch.eye(4)[:3].expand(count, 3, 4), torch.ones(count, 4), ("v",) * count, mask=mask)


LEVELS = torch.randint(0, 256, (2, 5, 4, 4), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("channels", [3, 4])
def test_deep_pixels_are_composed_as_8_bit_ones(channels):
    levels, behind = LEVELS[..., :channels], torch.tensor([0.2, 0.5, 0.9])
    torch.testing.assert_close(composite(levels, behind), composite(levels.float() / 255.0, behind))
    torch.testing.assert_close(unit(levels), unit(levels.float() / 255.0))


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.5, 0.9, 0.99, 1.0]))
def test_the_level_of_deep_pixels(seed, quantile):
    """The least of the colours that enough of all do not exceed, to a step of 16 bits."""
    colours = torch.rand(1, 6, 7, 3, generator=torch.Generator().manual_seed(seed)) * 0.02
    ordered = colours.flatten().sort().values
    expected = ordered[(torch.arange(1, len(ordered) + 1) >= quantile * len(ordered)).nonzero()[0, 0]]
    assert bright_level(views(colours), quantile) == pytest.approx(expected.item(), abs=1 / 65535)


@pytest.mark.parametrize("deep", [False, True])
def test_masked_pixels_do_not_count(deep):
    images = torch.full((1, 4, 4, 3), 20, dtype=torch.uint8)
    images[:, :, 2:] = 255
    mask = (torch.arange(4) < 2).expand(1, 4, 4)
    images = images / 255.0 if deep else images
    assert bright_level(views(images)) == 1.0
    assert bright_level(views(images, mask)) == pytest.approx(20 / 255, abs=1e-5)
    assert bright_level(views(images, torch.zeros_like(mask))) == 0.0
