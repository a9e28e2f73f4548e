"""Dark captures whose test frames list lit pictures, or none at all: LOM's and RealX3D's kinds."""

import json
import re
import warnings
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from ctm_scenes.trajectory import hemisphere
from layouts import INTRINSICS

from ctm_plugin.data.settings import NoiseConfig
from ctm_plugin.data.transforms import TransformsConfig
from ctm_plugin.errors import ConfigError, DataError

TRAIN, TEST = range(6), range(6, 9)


def names(numbers: range, folder: str) -> list[str]:
    return [f"{folder}/{number:02d}.png" for number in numbers]


def write(root: Path, train: list[str], test: list[str], **more: object) -> Path:
    """Files of both splits, as LOM's."""
    poses = hemisphere(len(train) + len(test), 4.0, seed=3)
    content = {**INTRINSICS, "near": 1.0, "far": 7.0, **more}
    for split, listed, part in (("train", train, poses[: len(train)]), ("test", test, poses[len(train) :])):
        frames = [
            {"file_path": name, "transform_matrix": pose.tolist()} for name, pose in zip(listed, part, strict=True)
        ]
        (root / f"transforms_{split}.json").write_text(json.dumps({**content, "frames": frames}))
    return root


@pytest.fixture
def room(tmp_path) -> Path:
    """Dark pictures in ``low``, the same ones ten times as bright (of 255 levels) in ``high``."""
    root = tmp_path / "room"
    rng = np.random.default_rng(0)
    for folder in ("low", "high"):
        (root / folder).mkdir(parents=True)
    for number in (*TRAIN, *TEST):
        dark = rng.integers(4, 25, (12, 16, 3), dtype=np.uint8)
        iio.imwrite(root / f"low/{number:02d}.png", dark)
        iio.imwrite(root / f"high/{number:02d}.png", 10 * dark)
    return write(root, names(TRAIN, "low"), names(TEST, "high"))


def load(root: Path, **settings):
    """The scene and what was told."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        scene = TransformsConfig(root=root, **settings).load()
    return scene, [str(each.message) for each in told]


def picture(path: Path) -> torch.Tensor:
    return torch.from_numpy(np.array(iio.imread(path)))


def test_both_folders(room):
    scene, told = load(room, dark="low", lit="high")
    assert told == []
    assert scene.test.pictured is None
    assert scene.train.lit is None
    for view, number in enumerate(TEST):
        assert torch.equal(scene.test.images[view], picture(room / f"low/{number:02d}.png"))
        assert torch.equal(scene.test.lit[view], picture(room / f"high/{number:02d}.png"))
    assert torch.equal(scene.train.images[2], picture(room / "low/02.png"))
    assert scene.test.names == ("06", "07", "08")


def test_lit_references_alone(room):
    scene, told = load(room, lit="high")
    assert scene.test.pictured.tolist() == [False] * 3
    assert not scene.test.images.any()
    assert torch.equal(scene.test.lit[0], picture(room / "high/06.png"))
    assert len(told) == 1
    assert re.search(
        r"transforms_test\.json: 3 of 3 test views have no picture to score against, such as 'high/06\.png'", told[0]
    )


def test_references_by_name_where_dark_pictures_are_listed(room):
    write(room, names(TRAIN, "low"), names(TEST, "low"))
    scene, told = load(room, lit="high")
    assert told == []
    assert scene.test.pictured is None
    assert torch.equal(scene.test.lit[1], picture(room / "high/07.png"))
    assert torch.equal(scene.test.images[1], picture(room / "low/07.png"))


def test_dark_pictures_of_which_some_are_missing(room):
    (room / "low/07.png").unlink()
    scene, told = load(room, dark="low", lit="high")
    assert scene.test.pictured.tolist() == [True, False, True]
    assert not scene.test.images[1].any()
    assert torch.equal(scene.test.images[2], picture(room / "low/08.png"))
    assert torch.equal(scene.test.lit[1], picture(room / "high/07.png"))
    assert "1 of 3 test views have no picture to score against, such as 'low/07.png'" in told[0]


def test_references_change_nothing_else(room):
    """They are shrunk with the pictures, and neither dimmed nor given noise."""
    settings = {"dark": "low", "width": 8, "exposure": 0.5, "noise": NoiseConfig(read=0.05)}
    with_lit, without = load(room, **settings, lit="high")[0], load(room, **settings)[0]
    assert torch.equal(with_lit.train.images, without.train.images)
    assert torch.equal(with_lit.test.images, without.test.images)
    assert (with_lit.near, with_lit.far, with_lit.random_level) == (without.near, without.far, without.random_level)
    bright = picture(room / "high/06.png").float()
    means = bright.reshape(6, 2, 8, 2, 3).mean((1, 3))
    assert (with_lit.test.lit[0] - means).abs().max() <= 0.51


def test_nobody_noticed(room):
    scene, told = load(room)
    assert scene.test.lit is None
    assert len(told) == 1
    said = r"room: test pictures are .* times as bright as those that are trained on.*, which is dataset\.lit=high "
    assert re.search(said + r"dataset\.dark=low$", told[0])
    for number in TEST:
        (room / f"low/{number:02d}.png").unlink()
    assert load(room)[1][0].endswith(", which is dataset.lit=high")


def test_light_that_varies_is_not_taken_for_references(room):
    for number in TEST:
        path = room / f"high/{number:02d}.png"
        iio.imwrite(path, (picture(path) // 8).numpy())
    assert load(room)[1] == []
    write(room, names(TRAIN, "high"), names(TEST, "high"))
    assert load(room)[1] == []


def test_test_pictures_that_are_not_there(room):
    """As RealX3D's: whatever is missing of the test pictures, training goes on."""
    write(room, names(TRAIN, "low"), names(range(20, 24), "test"))
    scene, told = load(room)
    assert scene.test.pictured.tolist() == [False] * 4
    assert scene.test.images.shape == (4, 12, 16, 3)
    assert not scene.test.images.any()
    assert scene.test.intrinsics[0].tolist() == pytest.approx([20, 19, 8.5, 5.5])
    assert scene.test.names == ("20", "21", "22", "23")
    (one,) = told
    assert "4 of 4 test views have no picture to score against, such as 'test/20.png': they are only rendered" in one


@pytest.mark.parametrize(
    ("settings", "error", "found"),
    [
        ({"lit": "bright"}, ConfigError, r"dataset\.lit: found 'bright', expected the name of a folder .*: high, low"),
        ({"dark": "high/06.png"}, ConfigError, r"dataset\.dark: found 'high/06\.png'"),
        ({"lit": "../room"}, DataError, "which leads outside"),
        ({"dark": "/tmp"}, DataError, "which leads outside"),
        ({"lit": "high", "dark": "high"}, ConfigError, r"dataset\.lit: found 'high', expected another folder than"),
        ({"lit": " "}, ConfigError, r"dataset\.lit: found ' '"),
        ({"lit": "low"}, ConfigError, r"a folder without training pictures, such as low/00\.png of .*train\.json"),
    ],
)
def test_settings_that_do_not_suit(room, settings, error, found):
    with pytest.raises(error, match=found):
        load(room, **settings)


def test_a_reference_that_is_missing_or_of_another_size(room):
    (room / "high/07.png").unlink()
    with pytest.raises(DataError, match=r"high/07\.png: found no such picture, expected one for each test view"):
        load(room, dark="low", lit="high")
    iio.imwrite(room / "high/07.png", np.zeros((6, 8, 3), np.uint8))
    found = r"high/07\.png: found a lit reference that becomes 8x6 pixels, expected 16x12 as the picture itself"
    with pytest.raises(DataError, match=found):
        load(room, dark="low", lit="high")


def test_one_file_with_lists(room):
    """The keys work for a single transforms.json too."""
    files = [json.loads((room / f"transforms_{split}.json").read_text()) for split in ("train", "test")]
    whole = {**files[0], "frames": files[0]["frames"] + files[1]["frames"], "test_filenames": names(TEST, "high")}
    for split in ("train", "test"):
        (room / f"transforms_{split}.json").unlink()
    (room / "transforms.json").write_text(json.dumps(whole))
    scene, told = load(room, dark="low", lit="high")
    assert told == []
    assert torch.equal(scene.test.lit[1], picture(room / "high/07.png"))
    assert torch.equal(scene.test.images[1], picture(room / "low/07.png"))


@pytest.mark.parametrize("scene", ["buu", "chair", "bike"])
def test_lom(ctm_data, scene):
    found, told = load(ctm_data / "lom" / scene, width=100, skip=9, dark="low", lit="high")
    assert len(told) == 1  # near and far
    assert found.test.pictured is None
    assert found.test.lit.float().mean() > 5 * found.test.images.float().mean()
    assert found.train.intrinsics[0, 0] / 100 == pytest.approx(found.test.intrinsics[0, 0] / 100)
    assert "dataset.lit=high dataset.dark=low" in load(ctm_data / "lom" / scene, width=100, skip=9)[1][0]


def test_realx3d(ctm_data):
    found, _ = load(ctm_data / "realx3d/BlueHawaii", width=147, skip=10, lit="test")
    assert found.test.pictured.tolist() == [False] * 6
    assert len(found.test.lit) == 6
    assert found.train.intrinsics[0].tolist() == pytest.approx(
        [1383.0651725255498 / 12, 115.2, 74.115, 47.89], rel=1e-2
    )
    found, told = load(ctm_data / "realx3d/Cupcake", width=147, skip=10)
    assert (len(found.train), len(found.test)) == (3, 6)
    assert not found.test.pictured.any()
    assert "6 of 6 test views have no picture to score against" in told[0]
