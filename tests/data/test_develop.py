"""From files to training images: sizes, bits, light that is clipped, masks."""

import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image
from png import png_16

from ctm_plugin.color.light import brighten
from ctm_plugin.data import develop as module
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.data.develop import develop, develop_depth, develop_masks, means_matter
from ctm_plugin.data.readers.images import read_picture
from ctm_plugin.data.settings import NoiseConfig, PhotoConfig
from ctm_plugin.errors import DataError

RNG = np.random.default_rng(0)


def deep(path: Path, code: np.ndarray) -> Path:
    path.write_bytes(png_16(code))
    return path


def shallow(path: Path, levels: np.ndarray) -> Path:
    Image.fromarray(levels).save(path)
    return path


def run(*paths: Path, **settings) -> torch.Tensor:
    config, pictures = PhotoConfig(**settings), [read_picture(path) for path in paths]
    canvas = config.shrunk(*pictures[0].header[:2])
    return develop(pictures, [path.stem for path in paths], config, noisy=False, canvas=canvas)


def test_8_bits_give_8_bits(tmp_path):
    levels = RNG.integers(0, 256, (6, 8, 3), dtype=np.uint8)
    images = run(shallow(tmp_path / "a.png", levels))
    assert images.dtype == torch.uint8
    np.testing.assert_array_equal(images[0], levels)


def test_16_bits_are_not_rounded_to_8(tmp_path):
    """Dimmed to 1/200 of the light, where 8 bits would leave some twenty levels."""
    code = RNG.integers(0, 2**16, (6, 8, 4), dtype=np.uint16)
    code[0, 0, 3] = 0
    path = deep(tmp_path / "a.png", code)
    images = run(path, exposure=0.005)
    assert images.dtype == torch.float32
    expected = brighten(torch.from_numpy(code[..., :3] / 65535.0), 0.005, "hard").numpy()
    expected[0, 0] = 0
    np.testing.assert_allclose(images[0, ..., :3], expected, atol=1e-6)


def test_one_deep_picture_makes_all_deep(tmp_path):
    levels, code = RNG.integers(0, 256, (4, 4, 3), dtype=np.uint8), RNG.integers(1, 2**16, (4, 4, 4), dtype=np.uint16)
    images = run(shallow(tmp_path / "a.png", levels), deep(tmp_path / "b.png", code))
    np.testing.assert_allclose(images[0, ..., :3], levels / 255, atol=1e-6)
    assert (images[0, ..., 3] == 1).all()  # opaque
    np.testing.assert_allclose(images[1], code / 65535, atol=1e-6)


def test_means_of_dark_pictures_keep_their_bits(tmp_path):
    """Where they are dark and become smaller; not where a camera of 8 bits is made up, or one is as good as another."""
    dark = shallow(tmp_path / "dark.png", RNG.integers(0, 6, (12, 16, 3), dtype=np.uint8))
    lit = shallow(tmp_path / "lit.png", RNG.integers(0, 256, (12, 16, 3), dtype=np.uint8))

    def matter(path, **settings):
        return means_matter([read_picture(path), None], PhotoConfig(**settings))

    assert matter(dark, downscale=4)
    assert matter(dark, width=8)
    assert not matter(dark)
    assert not matter(lit, downscale=4)
    assert not matter(dark, downscale=4, exposure=0.5)
    assert not matter(dark, downscale=4, noise=NoiseConfig(read=0.01))
    picture = read_picture(dark)
    images = develop([picture], ["dark"], PhotoConfig(downscale=4), noisy=False, canvas=(3, 4), deep=True)
    assert images.dtype == torch.float32
    expected = picture.image().numpy().reshape(3, 4, 4, 4, 3).mean((1, 3), dtype=np.float64)
    np.testing.assert_allclose(images[0], expected, atol=1e-7)


def test_training_and_test_pictures_keep_them_alike(ball, tmp_path):
    dark = Path(shutil.copytree(ball, tmp_path / "dark"))
    for path in dark.glob("t*/r_?.png"):
        levels = np.array(Image.open(path))
        levels[..., :3] //= 20
        shallow(path, levels)

    def kinds(root: Path, **settings) -> set[torch.dtype]:
        scene = BlenderConfig(root=root, **settings).load()
        return {views.images.dtype for views in (scene.train, scene.test)}

    assert kinds(dark, downscale=2) == {torch.float32}
    assert kinds(dark) == kinds(ball, downscale=2) == kinds(ball, downscale=2, exposure=0.01) == {torch.uint8}


def test_more_pictures_than_fit_into_memory(tmp_path, monkeypatch):
    """One small file listed often enough would fill it."""
    path = shallow(tmp_path / "a.png", np.zeros((8, 8, 4), np.uint8))
    monkeypatch.setattr(module, "memory", lambda: 3 * 8 * 8 * 4)
    run(*[path] * 3)
    with pytest.raises(DataError, match="found 4 pictures of 8x8, 0 GiB, expected less than the 0 GiB of this machine"):
        run(*[path] * 4)


def test_light_above_1_is_clipped_and_said_once(tmp_path):
    for index, most in enumerate((0.5, 2.0, 3.0)):
        light = np.full((4, 4, 3), 0.25, np.float32)
        light[0, 0] = most
        tifffile.imwrite(tmp_path / f"{index}.tif", light, photometric="rgb")
    paths = sorted(tmp_path.iterdir())
    with pytest.warns(UserWarning, match=r"2 of 3 pictures have light outside \[0, 1\], .* such as 1\.tif") as seen:
        images = run(*paths)
    assert len(seen) == 1
    assert (images[1:, 0, 0] == 1).all()
    assert images[:, 1, 1].numpy() == pytest.approx(1.055 * 0.25 ** (1 / 2.4) - 0.055)


def test_depth_at_its_own_scale(tmp_path):
    depth = np.arange(1, 21, dtype=np.float32)[:, None] * np.ones((1, 30), np.float32)
    np.save(tmp_path / "d.npy", depth)
    found = develop_depth([tmp_path / "d.npy"], 1.0, 7, 10)
    expected = [depth[math.floor((row + 0.5) * 20 / 7), 0] for row in range(7)]
    np.testing.assert_array_equal(found[0], np.repeat(np.array(expected)[:, None], 10, 1))
    with pytest.raises(DataError, match=r"d\.npy: found depth of 30x20 pixels, expected 31x20 as the images"):
        develop_depth([tmp_path / "d.npy"], 1.0, 20, 31)
    with pytest.raises(DataError, match=r"d\.npy: found depth of 30x20 pixels, expected 10x10"):
        develop_depth([tmp_path / "d.npy"], 1.0, 10, 10)


def test_masks(tmp_path):
    levels = np.zeros((6, 8), np.uint8)
    levels[:, 3:], levels[0, 4] = 128, 127
    path = shallow(tmp_path / "m.png", levels)
    whole, none = develop_masks([path, None], [(6, 8)] * 2, (6, 8))
    np.testing.assert_array_equal(whole, levels > 127)
    assert none.all()
    half = develop_masks([path], [(3, 4)], (3, 4))[0]
    np.testing.assert_array_equal(half, (levels > 127).reshape(3, 2, 4, 2).all((1, 3)))
    assert develop_masks([None, None], [(6, 8)] * 2, (6, 8)) is None
    small = develop_masks([None], [(3, 4)], (6, 8))[0]
    assert small[:3, :4].all()
    assert small.sum() == 12


@pytest.mark.parametrize("kind", ["white", "white LA", "cut out", "black and white"])
def test_masks_in_alpha(tmp_path, kind):
    """Alpha is the mask where it says something, whatever the colours are."""
    counts = np.zeros((6, 8), bool)
    counts[:3, :4] = True
    colour = {"cut out": np.random.default_rng(0).integers(0, 90, (6, 8, 3))}.get(kind, np.full((6, 8, 3), 255))
    alpha = 255 * counts[..., None]
    if kind == "black and white":
        colour, alpha = np.repeat(alpha, 3, -1), np.full_like(alpha, 255)
    image = Image.fromarray(np.concatenate([colour, alpha], -1).astype(np.uint8))
    (image.convert("LA") if kind == "white LA" else image).save(tmp_path / "m.png")
    np.testing.assert_array_equal(develop_masks([tmp_path / "m.png"], [(6, 8)], (6, 8))[0], counts)


@pytest.mark.parametrize(
    ("levels", "found"),
    [
        (np.full((6, 8), 127, np.uint8), "a mask that leaves no pixel of 8x6, expected one with some brighter"),
        (np.full((3, 4), 255, np.uint8), "a mask of 4x3 pixels, expected 8x6 as the images"),
        (np.full((12, 8), 255, np.uint8), "a mask of 8x12 pixels, expected 8x6 as the images"),
    ],
)
def test_masks_that_cannot_be(tmp_path, levels, found):
    with pytest.raises(DataError, match=rf"m\.png: found {found}"):
        develop_masks([shallow(tmp_path / "m.png", levels)], [(6, 8)], (6, 8))
