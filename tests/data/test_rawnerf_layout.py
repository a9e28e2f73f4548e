"""RawNeRF's layout: developed pictures where there are any, else DNGs, developed alike."""

import json
import sys

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from dng import NEUTRAL, camera_to_srgb, write_dng
from layouts import rawnerf_layout

from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.data.rawnerf import RawNeRFConfig, relative_brightness
from ctm_plugin.data.readers.images import read_picture
from ctm_plugin.data.readers.picture import exposure_of
from ctm_plugin.data.readers.raw import open_raw, raw_exif
from ctm_plugin.data.settings import RAWNERF_SCENES
from ctm_plugin.errors import ConfigError, CTMError, DataError

COUNT, SIZE, ANGLE = 9, (48, 32), 0.9
COLOR = np.array([0.06, 0.12, 0.05])


def flat(color) -> np.ndarray:
    return np.broadcast_to(color, (SIZE[1], SIZE[0], 3)).copy()


def exif(root, times, **more) -> None:
    for index, time in enumerate(times):
        (root / f"raw/IMG_{index:03d}.json").write_text(json.dumps([{"ShutterSpeed": time, **more}]))


def levels(linear: np.ndarray) -> torch.Tensor:
    return linear_to_srgb(torch.from_numpy(linear)).float()


@pytest.fixture
def night(tmp_path):
    """A dark wall of one colour in nine DNGs of equal exposure."""
    return rawnerf_layout(tmp_path / "bikes", flat(COLOR))


def test_developed_from_raw(night):
    scene = RawNeRFConfig(root=night, background="black").load()
    assert (scene.name, scene.geometry, scene.exposure, scene.near) == ("bikes", "forward", None, 1.0)
    assert scene.test.names == ("IMG_000", "IMG_008")
    assert scene.train.images.shape == (7, 8, 12, 3)
    assert scene.train.images.dtype == torch.float32  # a sensor's 14 bits and more, not 8
    assert (scene.train.images - levels(camera_to_srgb(COLOR))).abs().max() < 2e-3
    assert scene.train.images.std(dim=(0, 1, 2)).max() < 1e-6
    focal = 0.5 * 12 / np.tan(0.5 * ANGLE)
    assert scene.test.intrinsics[0].tolist() == pytest.approx([focal, focal, 6.0, 4.0], rel=1e-5)


def test_the_papers_settings(night):
    config = RawNeRFConfig(root=night.parent, scene="bikes")
    assert (config.background, config.downscale, config.test_every, len(RAWNERF_SCENES)) == ("random", 4, 8, 9)
    scene = config.load()
    assert (scene.name, scene.background) == ("bikes", "random")


def test_developed_pictures_come_first(night):
    (night / "images").mkdir()
    for index in range(COUNT):
        iio.imwrite(night / f"images/IMG_{index:03d}.png", np.full((32, 48, 3), 77, dtype=np.uint8))
    assert (RawNeRFConfig(root=night).load().train.images == 77).all()
    (night / "images").rename(night / "images_4")
    for path in (night / "images_4").iterdir():
        iio.imwrite(path, np.full((8, 12, 3), 55, dtype=np.uint8))
    assert (RawNeRFConfig(root=night).load().train.images == 55).all()
    assert (RawNeRFConfig(root=night, downscale=2).load().train.images != 55).any()  # from raw again


@pytest.mark.parametrize("color", [(0.02, 0.05, 0.04), (0.3, 0.5, 0.2), NEUTRAL, (0.9, 0.4, 0.1)])
def test_colours(tmp_path, color):
    """White balance, colour matrix and curve, worked out from the DNG's own numbers."""
    write_dng(tmp_path / "a.dng", flat(color))
    expected = linear_to_srgb(torch.from_numpy(camera_to_srgb(np.array(color)))).float()
    torch.testing.assert_close(read_picture(tmp_path / "a.dng", open_raw).image()[16, 24], expected, atol=2e-3, rtol=0)


def test_what_is_in_a_picture_does_not_change_how_it_is_developed(tmp_path):
    """A bright half, which an automatic exposure would take into account."""
    picture = flat(COLOR)
    picture[:, 24:] = 1.0
    write_dng(tmp_path / "a.dng", picture)
    write_dng(tmp_path / "b.dng", flat(COLOR))
    both = [read_picture(tmp_path / name, open_raw).image()[:, :16] for name in ("a.dng", "b.dng")]
    torch.testing.assert_close(*both, atol=2e-4, rtol=0)


def test_the_picture_stays_as_the_sensor_stands(tmp_path):
    picture = flat(COLOR)
    picture[:, :24] *= 4
    write_dng(tmp_path / "a.dng", picture, orientation=6)
    image = read_picture(tmp_path / "a.dng", open_raw).image()
    assert read_picture(tmp_path / "a.dng", open_raw).header[:2] == image.shape[:2] == (32, 48)
    assert (image[:, 2] > image[:, -2] + 0.1).all(dim=0).any()


def test_different_shutters_give_the_colours_of_the_longest(night):
    times = ["1/30"] * COUNT
    for index, time, share in ((2, "1/60", 0.5), (8, 1 / 120, 0.25)):
        write_dng(night / f"raw/IMG_{index:03d}.dng", flat(COLOR * share))
        times[index] = time
    exif(night, times)
    for path in (night / "raw").iterdir():
        path.rename(path.with_name(path.name.upper()))  # as from Windows
    scene = RawNeRFConfig(root=night).load()
    for views in (scene.train, scene.test):
        assert (views.images - levels(camera_to_srgb(COLOR))).abs().max() < 3e-3


@pytest.mark.parametrize(
    ("told", "factors"),
    [
        ([{"ShutterSpeed": "1/30"}, {"ShutterSpeed": 1 / 60}], [1, 2]),
        ([{"ShutterSpeed": "1/30", "ISO": 400}, {"ShutterSpeed": "1/60", "ISO": 100}], [1, 8]),
        ([{"ShutterSpeed": "2"}, {"ShutterSpeed": "2", "ISO": 200}], [2, 1]),
    ],
)
def test_exposures_by_exif(tmp_path, told, factors):
    paths = [tmp_path / f"{index}.json" for index in range(len(told))]
    for path, values in zip(paths, told, strict=True):
        path.write_text(json.dumps([values]))
    assert relative_brightness(paths, paths) == pytest.approx(factors)


@pytest.mark.parametrize("suffix", ["dng", "NEF"])
def test_exposures_by_the_pictures_own_exif(night, suffix):
    """No JSON lies there, as with everybody's own pictures; where one does not tell, all stay as shot."""
    for index in range(COUNT):
        share = 1 / (1 + index % 2)
        (night / f"raw/IMG_{index:03d}.dng").unlink()
        (night / f"raw/IMG_{index:03d}.json").unlink()
        write_dng(night / f"raw/IMG_{index:03d}.{suffix}", flat(COLOR * share), seconds=0.1 * share)
    views = RawNeRFConfig(root=night).load().train
    assert (views.images - levels(camera_to_srgb(COLOR))).abs().max() < 3e-3
    write_dng(night / f"raw/IMG_000.{suffix}", flat(COLOR))
    assert RawNeRFConfig(root=night).load().train.images.std() > 0.02


def test_a_raw_picture_that_tells_nothing(tmp_path):
    (tmp_path / "a.cr3").write_bytes(b"\0\0\0\x18ftypcrx " + bytes(200))
    assert exposure_of(raw_exif(tmp_path / "a.cr3")) is None


def test_rawpy_missing(night, monkeypatch):
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(CTMError, match=r"pip install -e '\.\[raw\]'"):
        RawNeRFConfig(root=night).load()


def test_unknown_scene(night):
    with pytest.raises(ConfigError, match=r"dataset\.scene: found 'moon', expected one of bikes, candlefiat"):
        RawNeRFConfig(root=night, scene="moon")
    with pytest.raises(DataError, match="scooter: found nothing there"):
        RawNeRFConfig(root=night.parent, scene="scooter").load()
    with pytest.raises(ConfigError, match=r"dataset\.root"):
        RawNeRFConfig(root="")
