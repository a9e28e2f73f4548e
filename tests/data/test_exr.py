"""EXR: what OpenEXR writes is read as linear light; the rest is refused."""

import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.data.readers.images import read_image, read_picture
from ctm_plugin.data.readers.picture import Header
from ctm_plugin.errors import CTMError, DataError

OpenEXR = pytest.importorskip("OpenEXR")
RNG = np.random.default_rng(0)


def write(path, channels, **header):
    kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File({**kind, **header}, channels).write(str(path))


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_light_through_the_curve(tmp_path, dtype):
    light = (RNG.random((4, 6, 3)) * 3).astype(dtype)
    write(tmp_path / "a.exr", {"RGB": light})
    assert read_picture(tmp_path / "a.exr").header == Header(4, 6, False, deep=True)
    torch.testing.assert_close(read_image(tmp_path / "a.exr"), linear_to_srgb(torch.from_numpy(light).float()))


def test_alpha_becomes_straight(tmp_path):
    """EXR's colour has alpha in it."""
    light = np.array([[[0.1, 0.2, 0.4, 0.5], [0.3, 0.0, 0.0, 0.0]]], np.float32)
    write(tmp_path / "a.exr", {"RGBA": light})
    assert read_picture(tmp_path / "a.exr").header.alpha
    expected = torch.cat([linear_to_srgb(torch.tensor([[0.2, 0.4, 0.8]])), torch.tensor([[0.5]])], 1)
    torch.testing.assert_close(read_image(tmp_path / "a.exr")[0], torch.cat([expected, torch.zeros(1, 4)]))


def truncated(path):
    path.write_bytes(path.read_bytes()[:-40])


def window(path):
    low, high = np.array([0, 0], np.int32), np.array([9, 9], np.int32)
    write(path, {"RGB": np.zeros((4, 6, 3), np.float32)}, displayWindow=(low, high))


@pytest.mark.parametrize(
    ("spoil", "found"),
    [
        (lambda path: path.write_bytes(b""), "an empty file"),
        (lambda path: path.write_bytes(b"hello"), "an EXR that cannot be read"),
        (truncated, "an EXR that cannot be read"),
        (window, r"a data window \[0, 0\] to \[5, 3\], expected all of its display window, \[0, 0\] to \[9, 9\]"),
        (lambda path: write(path, {"Z": np.zeros((4, 6), np.float32)}), "channels Z, expected a whole EXR"),
        (lambda path: write(path, {"RGB": np.full((4, 6, 3), np.nan, np.float32)}), "NaN or infinity"),
        (lambda path: path.unlink(), "no such file"),
    ],
)
def test_spoilt(tmp_path, spoil, found):
    path = tmp_path / "a.exr"
    write(path, {"RGB": RNG.random((8, 12, 3)).astype(np.float32)})
    spoil(path)
    with pytest.raises(DataError, match=rf"a\.exr: found {found}"):
        read_image(path)


def test_absurd_sizes_are_refused_without_decoding(tmp_path):
    path, old = tmp_path / "a.exr", np.array([0, 0, 5, 3], "<i4").tobytes()
    write(path, {"RGB": np.zeros((4, 6, 3), np.float32)})
    path.write_bytes(path.read_bytes().replace(old, np.array([0, 0, 99999, 99999], "<i4").tobytes()))
    with pytest.raises(DataError, match=r"a\.exr: found an image of 100000x100000 pixels"):
        read_picture(path)


@settings(max_examples=60)
@given(data=st.data())
def test_damaged_ones_load_or_are_refused(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "damaged.exr"
    write(path, {"RGB": np.full((4, 6, 3), 0.25, np.float32)})
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        image = read_image(path)
    except DataError:
        return
    assert image.isfinite().all()


def test_the_extra_is_named(tmp_path, monkeypatch):
    write(tmp_path / "a.exr", {"RGB": np.zeros((4, 6, 3), np.float32)})
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(CTMError, match=r"a\.exr needs OpenEXR: pip install -e '\.\[exr\]'"):
        read_picture(tmp_path / "a.exr")
