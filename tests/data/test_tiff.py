"""TIFF: what tifffile and PIL write is read back, bits and all; the rest is refused."""

import struct

import numpy as np
import pytest
import tifffile
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.data.readers.images import read_image, read_picture
from ctm_plugin.data.readers.picture import Header
from ctm_plugin.errors import DataError

RNG = np.random.default_rng(0)
ORIENTATION = 274


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_whole_numbers(tmp_path, dtype, channels, compression):
    top = np.iinfo(dtype).max
    code = RNG.integers(0, top, (5, 7, channels), dtype=dtype, endpoint=True)
    extra = {"extrasamples": ["unassalpha"]} if channels == 4 else {}
    kind = "rgb" if channels > 1 else "minisblack"
    tifffile.imwrite(tmp_path / "a.tif", code.squeeze(), photometric=kind, compression=compression, **extra)
    assert read_picture(tmp_path / "a.tif").header == Header(5, 7, channels == 4, deep=dtype == np.uint16)
    expected = np.broadcast_to(code, (5, 7, max(3, channels))) / top
    np.testing.assert_allclose(read_image(tmp_path / "a.tif"), expected, atol=1e-7)


def test_planes_apart(tmp_path):
    code = RNG.integers(0, 2**16, (3, 5, 7), dtype=np.uint16)
    tifffile.imwrite(tmp_path / "a.tiff", code, photometric="rgb", planarconfig="separate")
    np.testing.assert_allclose(read_image(tmp_path / "a.tiff"), np.moveaxis(code, 0, -1) / 65535, atol=1e-7)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_floats_are_light(tmp_path, dtype):
    light = (RNG.random((4, 6, 3)) * 3).astype(dtype)
    tifffile.imwrite(tmp_path / "a.tif", light, photometric="rgb")
    image = read_image(tmp_path / "a.tif")
    torch.testing.assert_close(image, linear_to_srgb(torch.from_numpy(light).float()))
    assert image.max() > 1  # clipped where all pictures are, which is said once


def test_multiplied_alpha_becomes_straight(tmp_path):
    code = np.array([[[1000, 2000, 4000, 8000], [0, 0, 0, 0]]], np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", code, photometric="rgb", extrasamples=["assocalpha"])
    expected = [[1 / 8, 1 / 4, 1 / 2, 8000 / 65535], [0, 0, 0, 0]]
    np.testing.assert_allclose(read_image(tmp_path / "a.tif")[0], expected, atol=1e-6)


def test_its_orientation_is_applied(tmp_path):
    levels = RNG.integers(0, 256, (4, 6, 3), dtype=np.uint8)
    tifffile.imwrite(tmp_path / "a.tif", levels, photometric="rgb", extratags=[(ORIENTATION, 3, 1, 6, True)])
    assert read_picture(tmp_path / "a.tif").header == Header(6, 4, False, orientation=6)
    np.testing.assert_allclose(read_image(tmp_path / "a.tif"), np.rot90(levels, -1) / 255, atol=1e-7)


def truncated(path):
    path.write_bytes(path.read_bytes()[:-40])


def lzw(path):
    Image.fromarray(RNG.integers(0, 256, (9, 9, 3), dtype=np.uint8)).save(path, compression="tiff_lzw")


def claims_more(path):
    """Width and height, tags 256 and 257, of 2^20 each."""
    content = path.read_bytes()
    for tag, kind, count in ((256, 3, 1), (256, 4, 1), (257, 3, 1), (257, 4, 1)):
        at = content.find(struct.pack("<HHI", tag, kind, count))
        if at >= 0:
            content = content[:at] + struct.pack("<HHII", tag, 4, 1, 2**20) + content[at + 12 :]
    path.write_bytes(content)


def write(array, **more):
    return lambda path: tifffile.imwrite(path, array, **more)


@pytest.mark.parametrize(
    ("spoil", "found"),
    [
        (lambda path: path.write_bytes(b""), "an empty file"),
        (lambda path: path.write_bytes(b"hello"), "a TIFF that cannot be read"),
        (truncated, "a TIFF that cannot be read"),
        (claims_more, "an image of 1048576x1048576 pixels, expected a whole TIFF"),
        (lzw, "a TIFF that cannot be read .*imagecodecs"),
        (write(np.full((4, 4, 3), np.nan, np.float32), photometric="rgb"), "NaN or infinity"),
        (write(np.zeros((4, 4), np.int16)), "YX of 1 samples, int16"),
        (write(np.zeros((4, 4), bool)), "YX of 1 samples, bool"),
        (write(np.zeros((4, 4), np.uint8), photometric="miniswhite"), "photometric 0"),
        (write(np.zeros((4, 4, 4), np.uint8), photometric="rgb", extrasamples=["unspecified"]), "more samples"),
        (lambda path: path.unlink(), "no such file"),
    ],
)
def test_spoilt(tmp_path, spoil, found):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, RNG.integers(0, 256, (16, 16, 3), dtype=np.uint8), photometric="rgb", metadata=None)
    spoil(path)
    with pytest.raises(DataError, match=rf"a\.tif: found .*{found}"):
        read_image(path)


@given(data=st.data())
def test_damaged_ones_load_or_are_refused(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "damaged.tif"
    tifffile.imwrite(path, RNG.integers(0, 2**16, (6, 5, 3), dtype=np.uint16), photometric="rgb", compression="zlib")
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        image = read_image(path)
    except DataError:
        return
    assert image.shape[2] in (3, 4)
    assert image.isfinite().all()
