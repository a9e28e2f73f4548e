"""Pictures and depth as files, against a second reading of the files."""

import os

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.scenes.encode import DEPTH_SCALE, decode_depth, encode_depth, to_rgba8, write_npy, write_png


@given(st.floats(0.02, 1.0), st.floats(0.0, 1.0))
def test_alpha_is_straight(alpha, light):
    pixel = np.array([[[light * alpha, 0.0, alpha, alpha]]], dtype=np.float32)
    expected = [255.0 * linear_to_srgb(torch.tensor(light)).item(), 0.0, 255.0, 255.0 * alpha]
    np.testing.assert_allclose(to_rgba8(pixel)[0, 0], expected, atol=0.51)


def test_light_outside_its_range_is_cut():
    pixels = np.array([[[-1.0, 0.0, 7.0, 1.0]]], dtype=np.float32)
    assert to_rgba8(pixels).tolist() == [[[0, 0, 255, 255]]]


def test_colour_under_no_alpha_is_zero():
    image = np.array([[[0.0, 0.0, 0.0, 0.0], [1e-4, 1e-4, 1e-4, 1e-4], [0.3, 0.2, 0.1, -0.1]]], dtype=np.float32)
    assert not to_rgba8(image).any()


@given(st.lists(st.floats(0.01, 15.9), min_size=1, max_size=20))
def test_depth_survives_16_bits(values):
    depth = np.array([*values, np.nan])
    decoded = decode_depth(encode_depth(depth))
    np.testing.assert_allclose(decoded, depth, atol=0.51 * DEPTH_SCALE)
    assert DEPTH_SCALE < 1e-3


@pytest.mark.parametrize("value", [0.0, -1.0, 16.0])
def test_depth_that_does_not_fit(value):
    with pytest.raises(ValueError, match="depth outside"):
        encode_depth(np.array([value]))


@pytest.mark.parametrize(("kind", "shape"), [(np.uint8, (9, 7, 4)), (np.uint8, (9, 7, 3)), (np.uint16, (9, 7))])
def test_png_is_lossless(tmp_path, kind, shape):
    image = np.random.default_rng(0).integers(0, np.iinfo(kind).max + 1, shape, dtype=kind)
    write_png(tmp_path / "a.png", image)
    back = iio.imread(tmp_path / "a.png")
    assert back.dtype == kind
    np.testing.assert_array_equal(back, image)
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]


def test_arrays_are_whole_or_absent(tmp_path, monkeypatch):
    old = np.array([[1.5, np.nan]], dtype=np.float32)
    write_npy(tmp_path / "a.npy", old)

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", stop)
    with pytest.raises(KeyboardInterrupt):
        write_npy(tmp_path / "a.npy", 2 * old)
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), old)
    assert [file.name for file in tmp_path.iterdir()] == ["a.npy"]
