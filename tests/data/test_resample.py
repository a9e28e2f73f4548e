"""Pictures, depth and masks made smaller, against float64 written by hand."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from ctm_plugin.data.readers.images import to_8_bits
from ctm_plugin.scene.shrink import STRIP, area, shrink, shrink_depth, shrink_mask

SIDES = st.integers(1, 17).flatmap(lambda large: st.tuples(st.just(large), st.integers(1, large)))


def premultiplied_mean(levels: np.ndarray, factor: int) -> np.ndarray:
    """Premultiplied box average in float64: ``[H, W, 4]`` uint8 to ``[H/f, W/f, 4]`` in [0, 255]."""
    height, width = levels.shape[0] // factor, levels.shape[1] // factor
    blocks = levels.astype(np.float64).reshape(height, factor, width, factor, 4)
    weight = blocks[..., 3:].sum(axis=(1, 3))
    colour = (blocks[..., :3] * blocks[..., 3:]).sum(axis=(1, 3)) / np.maximum(weight, 1e-9)
    return np.concatenate([colour, weight / factor**2], axis=-1)


def overlaps(large: int, small: int) -> np.ndarray:
    """``[small, large]``: the share of each larger pixel that each pixel covers."""
    edge = np.arange(small + 1) * large / small
    pixel = np.arange(large)
    shared = np.minimum(edge[1:, None], pixel + 1) - np.maximum(edge[:-1, None], pixel)
    return shared.clip(min=0) * small / large


@given(npst.arrays(np.uint8, st.tuples(st.just(6), st.just(12), st.just(4))), st.sampled_from([1, 2, 3, 6]))
def test_shrink_by_a_divisor_is_the_box_average(levels, factor):
    small = shrink(torch.from_numpy(levels).float() / 255.0, 6 // factor, 12 // factor).numpy() * 255.0
    expected = premultiplied_mean(levels, factor)
    np.testing.assert_allclose(small[..., 3], expected[..., 3], atol=1e-3)
    seen = expected[..., 3] > 0
    np.testing.assert_allclose(small[seen], expected[seen], atol=1e-3)


@given(SIDES, SIDES, st.integers(0, 2**32 - 1))
def test_means_over_areas(rows, columns, seed):
    image = np.random.default_rng(seed).random((rows[0], columns[0], 3))
    expected = np.einsum("ih,jw,hwc->ijc", overlaps(*rows), overlaps(*columns), image)
    found = area(torch.from_numpy(image).float(), rows[1], columns[1])
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize(("height", "channels"), [(STRIP + 3, 3), (2 * STRIP, 3), (9, 4)])
def test_8_bits_shrink_as_their_floats_do(height, channels):
    """By 2, of more rows than a strip has, and by no whole number."""
    levels = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (2 * height, 8, channels), dtype=np.uint8))
    for size in ((2 * height, 8), (height, 4), (height, 3)):
        assert torch.equal(shrink(levels, *size), shrink(levels.float() / 255.0, *size))
        assert shrink(levels, *size).shape == (*size, channels)


@given(SIDES, SIDES, st.integers(0, 2**32 - 1))
def test_colour_counts_by_its_alpha(rows, columns, seed):
    image = np.random.default_rng(seed).uniform(1e-3, 1, (rows[0], columns[0], 4))
    both = overlaps(*rows), overlaps(*columns)
    alpha = np.einsum("ih,jw,hw->ij", *both, image[..., 3])
    colour = np.einsum("ih,jw,hwc,hw->ijc", *both, image[..., :3], image[..., 3]) / alpha[..., None]
    found = shrink(torch.from_numpy(image).float(), rows[1], columns[1])
    np.testing.assert_allclose(found[..., 3], alpha, atol=1e-6)
    np.testing.assert_allclose(found[..., :3], colour, atol=2e-5)


@given(npst.arrays(np.uint8, st.tuples(st.just(4), st.just(4), st.just(3))))
def test_colour_under_alpha_0_is_never_read(garbage):
    clean = np.random.default_rng(0).integers(0, 256, (4, 4, 4), dtype=np.uint8)
    clean[:2, :, 3] = 0
    dirty = clean.copy()
    dirty[:2, :, :3] = garbage[:2]
    for size in (4, 3, 2, 1):
        a, b = (to_8_bits(shrink(torch.from_numpy(x).float() / 255.0, size, size)) for x in (clean, dirty))
        assert torch.equal(a, b)
        assert (a[a[..., 3] == 0] == 0).all()


@given(SIDES, SIDES, st.integers(0, 2**32 - 1))
def test_a_pixel_counts_where_all_of_its_area_counts(rows, columns, seed):
    mask = np.random.default_rng(seed).random((rows[0], columns[0])) < 0.7
    left_out = np.einsum("ih,jw,hw->ij", overlaps(*rows), overlaps(*columns), ~mask)
    found = shrink_mask(torch.from_numpy(mask), rows[1], columns[1])
    np.testing.assert_array_equal(found, left_out < 1e-6)


@pytest.mark.parametrize("factor", [1, 2, 3, 4, 6])
def test_shrunk_depth_is_the_nearest_to_the_centre(factor):
    y, x = torch.meshgrid(torch.arange(12) + 0.5, torch.arange(12) + 0.5, indexing="ij")
    centre = (torch.arange(12 // factor) + 0.5) * factor
    for grid, axis in ((y, 0), (x, 1)):
        off = shrink_depth(grid, 12 // factor, 12 // factor) - (centre[:, None] if axis == 0 else centre[None, :])
        assert (off == (0.5 if factor % 2 == 0 else 0.0)).all()
