"""Patches of a picture: where they come from, what is done to the picture, what is refused."""

from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.transform import ProjectiveTransform
from skimage.transform import warp as skimage_warp

from ctm_plugin.color.light import brighten
from ctm_plugin.data.planar import PATCH_DIRECTIONS, PlanarConfig, cut, draw_warps, fitted
from ctm_plugin.data.settings import PHOTOGRAPHS, NoiseConfig
from ctm_plugin.errors import ConfigError, DataError
from ctm_plugin.rays.homography import patch_corners, sl3_exp, to_pixels, warp

SMALL = {"height": 30, "width": 40, "patch": 12}


@pytest.fixture
def picture(tmp_path):
    levels = np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    iio.imwrite(tmp_path / "noise.png", levels)
    return tmp_path / "noise.png", torch.from_numpy(levels).float() / 255


@pytest.mark.parametrize("name", PHOTOGRAPHS)
@pytest.mark.filterwarnings("ignore:.*scaled from")
def test_photographs_of_scikit_image(name):
    scene = PlanarConfig(image=name).load()
    assert scene.name == name
    assert scene.image.shape == (360, 480, 3)
    assert scene.patches.shape == (5, 180, 180, 3)
    assert scene.image.std() / scene.image.mean() > 0.2


def test_a_picture_of_the_right_size_is_taken_as_it_is(picture):
    path, pixels = picture
    scene = PlanarConfig(image=path, **SMALL).load()
    assert torch.equal(scene.image, pixels)
    torch.testing.assert_close(scene.patches[0], pixels[9:21, 14:26])
    assert torch.equal(scene.true_warps[0], torch.zeros(8))
    assert torch.equal(scene.patches, scene.clean)


def test_patches_against_scikit_image(picture):
    _, pixels = picture
    h = torch.tensor([[0.1, -0.05, 0.05, -0.1, 0.08, -0.03, 0.1, 0.07]])
    patch = cut(pixels, h, 12)[0]
    # From the patch's pixels to ours, through the units of the grid: index -> unit -> homography -> index.
    unit = ProjectiveTransform(np.array([[1 / 20, 0, (14.5 - 20) / 20], [0, 1 / 20, (9.5 - 15) / 20], [0, 0, 1]]))
    back = ProjectiveTransform(np.array([[20, 0, 19.5], [0, 20, 14.5], [0, 0, 1]]))
    matrix = back.params @ sl3_exp(h[0].double()).numpy() @ unit.params
    expected = skimage_warp(pixels.numpy(), ProjectiveTransform(matrix), output_shape=(12, 12), order=1)
    torch.testing.assert_close(patch, torch.from_numpy(expected), atol=2e-5, rtol=0)


@pytest.mark.slow
@given(st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_all_corners_lie_inside(seed):
    config = PlanarConfig(seed=seed)
    warps = draw_warps(config)
    corners = to_pixels(warp(patch_corners(360, 480, 180), sl3_exp(warps)), 360, 480)
    assert (corners >= 0).all()
    assert (corners <= torch.tensor([480, 360])).all()
    assert torch.equal(warps, draw_warps(config))


@pytest.mark.slow
def test_four_patches_go_to_the_corners():
    warps = torch.stack([draw_warps(PlanarConfig(seed=seed)) for seed in range(80)])
    torch.testing.assert_close(warps.mean(0)[:, :2], 0.2 * PATCH_DIRECTIONS, atol=0.05, rtol=0)
    assert 0.07 < warps[:, 1:, 2:].std() < 0.11  # less than noise_h: what does not fit is drawn again
    assert not torch.equal(warps[0], warps[1])


def test_exposure_and_noise(picture):
    path, pixels = picture
    noise = NoiseConfig(read=0.01, shot=0.0)
    scene = PlanarConfig(image=path, exposure=0.1, noise=noise, **SMALL).load()
    assert (scene.image - brighten(pixels, 0.1, "hard")).abs().max() <= 0.5 / 255 + 1e-6
    assert scene.exposure == 0.1
    assert (scene.patches - scene.clean).std() > 0.01
    again = PlanarConfig(image=path, exposure=0.1, noise=noise, **SMALL).load()
    other = PlanarConfig(image=path, exposure=0.1, noise=replace(noise, seed=1), **SMALL).load()
    assert torch.equal(scene.patches, again.patches)
    assert not torch.equal(scene.patches, other.patches)
    assert torch.equal(scene.clean, other.clean)


@pytest.mark.parametrize(("shape", "size"), [((60, 80), (30, 40)), ((60, 100), (30, 40)), ((15, 25), (30, 40))])
def test_scaled_to_cover_and_cut(shape, size):
    y, x = torch.meshgrid(torch.arange(shape[0]), torch.arange(shape[1]), indexing="ij")
    ramp = torch.stack([x / shape[1], y / shape[0], torch.full(shape, 0.5)], dim=-1)
    out = fitted(ramp, *size)
    assert out.shape == (*size, 3)
    torch.testing.assert_close(out.mean((0, 1)), ramp.mean((0, 1)), atol=0.02, rtol=0)
    scale = max(size[0] / shape[0], size[1] / shape[1])
    across = (out[:, -2, 0] - out[:, 1, 0]).mean() / (size[1] - 3)
    assert across.item() == pytest.approx(1 / shape[1] / scale, rel=0.02)


@pytest.mark.parametrize(
    ("dtype", "channels", "said"), [("uint8", 4, "8 bits with transparency"), ("uint16", 1, "more than 8 bits")]
)
def test_other_pictures_are_converted_and_it_is_said(tmp_path, dtype, channels, said):
    top = np.iinfo(dtype).max
    levels = np.random.default_rng(0).integers(0, top, (30, 40, channels), dtype=dtype)
    iio.imwrite(tmp_path / "a.png", levels.squeeze())
    with pytest.warns(UserWarning, match=rf"a\.png: converted from {said}"):
        scene = PlanarConfig(image=tmp_path / "a.png", **SMALL).load()
    expected = levels[..., :3] / top * (levels[..., 3:] / top if channels == 4 else np.ones(3))
    np.testing.assert_allclose(scene.image.numpy(), expected, atol=0.51 / 255)


def test_bad_pictures(picture, tmp_path):
    path, _ = picture
    with pytest.raises(DataError, match=r"nowhere\.png: found no such file, expected a picture, or one of astronaut"):
        PlanarConfig(image=tmp_path / "nowhere.png").load()
    with pytest.raises(DataError, match=r"noise\.png: found a picture of 40x30, expected one at least as large as a"):
        PlanarConfig(image=path).load()
    (tmp_path / "text.png").write_text("hello")
    with pytest.raises(DataError, match=r"text\.png: found something that is not an image"):
        PlanarConfig(image=tmp_path / "text.png").load()


def test_patches_that_do_not_fit(picture):
    path, _ = picture
    with pytest.raises(ConfigError, match=r"dataset\.patch: found 28, expected one that, moved by dataset"):
        PlanarConfig(image=path, height=30, width=40, patch=28, noise_t=1.5).load()
