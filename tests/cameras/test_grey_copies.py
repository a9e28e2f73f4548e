"""Dark photographs made bright: grey by their light, one factor found from all of them."""

from functools import partial

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.cameras.search import STRIP, as_grey, find_gain, read_light
from ctm_plugin.color.light import LUMINANCE, TARGET_MEAN, brighten
from ctm_plugin.data.readers.deep import write_tiff
from ctm_plugin.data.readers.images import read_picture
from ctm_plugin.data.readers.picture import Lens


def test_light_is_averaged_and_not_its_code(tmp_path):
    """Black and white columns are half the light, whose code is 188, not 128."""
    path = tmp_path / "stripes.png"
    iio.imwrite(path, np.tile(np.array([0, 255], dtype=np.uint8)[:, None], (4, 2, 3)).reshape(4, 4, 3))
    grey = as_grey(read_light(read_picture(path), 2).light)
    torch.testing.assert_close(grey * 255, torch.full((2, 2), 187.5), atol=0.1, rtol=0)


def test_primaries_weigh_as_the_eye_sees_them(tmp_path):
    path = tmp_path / "primaries.png"
    iio.imwrite(path, (np.eye(3) * 255).astype(np.uint8)[None])
    torch.testing.assert_close(read_light(read_picture(path), 3).light, torch.tensor([[0.2126, 0.7152, 0.0722]]))


def test_what_no_factor_divides_is_cut(tmp_path):
    iio.imwrite(tmp_path / "odd.png", np.full((7, 11, 3), 255, dtype=np.uint8))
    light, scale = read_light(read_picture(tmp_path / "odd.png"), 4)
    assert (*light.shape, scale) == (2, 3, 3)


@pytest.mark.parametrize(("name", "kind"), [("noise.png", np.uint8), ("noise.tif", np.uint16)])
def test_light_of_strips_is_that_of_the_whole(tmp_path, name, kind):
    """Of 8 bits by a table, of more by the formula; more rows than a strip has."""
    levels = np.random.default_rng(0).integers(0, np.iinfo(kind).max, (3 * (2 * STRIP + 5) + 1, 12, 3), dtype=kind)
    write = iio.imwrite if kind is np.uint8 else partial(write_tiff, orientation=1, lens=Lens())
    write(tmp_path / name, levels)
    codes = levels[:-1] / np.iinfo(kind).max
    light = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4) @ LUMINANCE
    found = read_light(read_picture(tmp_path / name), -(-len(levels) // 3)).light
    np.testing.assert_allclose(found, light.reshape(-1, 3, 4, 3).mean((1, 3)), atol=1e-6)


@given(st.floats(0.01, 0.3), st.integers(0, 99))
def test_the_mean_becomes_mid_grey_by_one_factor(level, seed):
    """Of all pictures together: dark ones stay darker than others."""
    greys = [torch.rand(9, 7, generator=torch.Generator().manual_seed(seed)) * level * part for part in (0.5, 1.0)]
    gain = find_gain(greys)
    bright = [brighten(grey, gain).mean().item() for grey in greys]
    assert sum(bright) / 2 == pytest.approx(TARGET_MEAN.at, abs=1e-3)
    assert bright[0] < bright[1]


def test_bright_pictures_and_black_ones_are_left_alone():
    assert find_gain([torch.full((4, 4), 0.8)]) == 1.0
    assert find_gain([torch.zeros(4, 4)]) == 1.0
