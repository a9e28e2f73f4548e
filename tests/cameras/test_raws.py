"""Raw pictures of a capture: one white balance, one exposure, all bits; what is there stays."""

import sys

import numpy as np
import pytest
from dng import camera_to_srgb, write_dng
from PIL import Image

from ctm_plugin.cameras.photographs import list_photographs
from ctm_plugin.cameras.raws import develop_raws
from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.data.readers.images import read_image, read_picture
from ctm_plugin.data.readers.picture import Lens
from ctm_plugin.data.readers.raw import read_mosaic
from ctm_plugin.errors import CTMError, DataError

COLOR = np.array([0.06, 0.12, 0.05])


def flat(color: np.ndarray) -> np.ndarray:
    return np.broadcast_to(color, (32, 48, 3)).copy()


@pytest.fixture
def night(tmp_path):
    for number, share in enumerate((1.0, 0.5, 0.25)):
        write_dng(tmp_path / f"IMG_{number}.DNG", flat(COLOR * share), seconds=0.2 * share, orientation=6)
    return tmp_path


def test_all_have_the_light_of_the_longest(night, capsys):
    develop_raws(night)
    folder = night / "developed"
    told = "3 raw pictures developed with one white balance, exposures evened by up to 4 times"
    assert capsys.readouterr().out == f"{told}: {folder}\n"
    expected = linear_to_srgb(read_image(folder / "IMG_0.tif").new_tensor(camera_to_srgb(COLOR)))
    for number in range(3):
        assert (read_image(folder / f"IMG_{number}.tif") - expected).abs().max() < 3e-3
        header = read_picture(folder / f"IMG_{number}.tif").header
        assert (header.deep, header.orientation, header.height, header.width) == (True, 6, 48, 32)


def test_hot_pixels_are_repaired(tmp_path, monkeypatch, capsys):
    decoded = []
    monkeypatch.setattr("ctm_plugin.cameras.raws.read_mosaic", lambda path: decoded.append(path) or read_mosaic(path))
    for number in range(6):
        sensor = np.random.default_rng(number).normal(0.02, 0.004, (48, 64, 3))
        sensor[20, 30] = 0.5
        write_dng(tmp_path / f"{number}.dng", sensor)
    develop_raws(tmp_path)
    said = "6 raw pictures developed with one white balance, 1 hot pixels repaired: "
    assert capsys.readouterr().out.startswith(said)
    for path in (tmp_path / "developed").iterdir():
        assert srgb_to_linear(read_image(path)).max() < 0.1
    assert sorted(decoded) == sorted(tmp_path.glob("*.dng"))  # each once


def test_the_lens_is_told(tmp_path):
    for name in "abc":
        write_dng(tmp_path / f"{name}.dng", flat(COLOR))
    develop_raws(tmp_path)
    assert read_picture(tmp_path / "developed" / "a.tif").header.lens == Lens("Test", "Test")


def test_they_are_used_again_and_go_before_the_cameras_own_jpeg(night, capsys):
    (night / "odd.CR3").write_bytes(b"odd" * 50)
    Image.fromarray(np.full((48, 32, 3), 9, np.uint8)).save(night / "IMG_1.JPG")
    with pytest.warns(UserWarning, match=r"odd\.CR3: found a file that cannot be developed .*; it is left out"):
        develop_raws(night)
    before = {path: path.stat().st_mtime_ns for path in (night / "developed").iterdir()}
    with pytest.warns(UserWarning, match="it is left out"):
        develop_raws(night)
    assert {path: path.stat().st_mtime_ns for path in (night / "developed").iterdir()} == before
    assert "3 pictures in" in capsys.readouterr().out.splitlines()[-1]
    for number in range(3):  # as if each showed something else
        path = night / "developed" / f"IMG_{number}.tif"
        path.write_bytes(path.read_bytes() + bytes(number))
    with pytest.warns(UserWarning, match="copies left out: 1, as 'IMG_1.JPG'"):
        assert list_photographs(night, "images") == sorted(before)


def test_not_one_that_can_be_developed(tmp_path, night, monkeypatch):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "odd.ARW").write_bytes(b"")
    with pytest.raises(DataError, match=r"odd\.ARW: found an empty file"):
        develop_raws(tmp_path / "other")
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(CTMError, match="developing raw pictures needs rawpy"):
        develop_raws(night)
