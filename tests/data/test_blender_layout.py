"""The Blender layout: what is read from good data sets, tiny and real."""

import json
import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from layouts import blender_layout
from PIL import Image
from test_resample import premultiplied_mean

from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.errors import DataError


def load(root: Path, **config):
    return BlenderConfig(root=root, **config).load()


def levels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path))


def edit(path: Path, **values) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def test_reads_a_tiny_data_set(tiny):
    scene = load(tiny)
    assert (scene.name, scene.geometry, scene.background, scene.exposure) == ("tiny", "bounded", "white", 1.0)
    assert (scene.near, scene.far) == (2.0, 6.0)
    assert (len(scene.train), len(scene.test)) == (3, 2)
    assert scene.train.names == ("r_0", "r_1", "r_2")
    assert scene.train.depth is None
    assert scene.test.depth is None
    content = json.loads((tiny / "transforms_train.json").read_text())
    for index, frame in enumerate(content["frames"]):
        stored = levels(tiny / f"train/r_{index}.png").copy()
        stored[stored[..., 3] == 0] = 0
        assert (scene.train.images[index].numpy() == stored).all()
        np.testing.assert_allclose(scene.train.c2w[index], np.array(frame["transform_matrix"])[:3], atol=1e-6)
    focal = 4.0 / math.tan(0.35)
    torch.testing.assert_close(scene.train.intrinsics, torch.tensor([[focal, focal, 4.0, 4.0]] * 3))


def test_lenses_are_read_as_in_transforms(tiny, monkeypatch):
    """Synthetic-NeRF's bounds and order are only for files that say no more than camera_angle_x."""
    edit(tiny / "transforms_train.json", cx=3.0)
    monkeypatch.chdir(tiny)
    with pytest.warns(UserWarning, match="no near and far there; 2 and 8 are taken from where the cameras stand"):
        scene = load(".")
    assert scene.train.intrinsics[0, 2] == 3.0
    assert scene.test.intrinsics[0, 2] == 4.0


def test_equal_file_names_get_numbers(tiny):
    content = json.loads((tiny / "transforms_train.json").read_text())
    (tiny / "more").mkdir()
    (tiny / "train/r_1.png").rename(tiny / "more/r_0.png")
    content["frames"][1]["file_path"] = "more/r_0"
    (tiny / "transforms_train.json").write_text(json.dumps(content))
    assert load(tiny).train.names == ("0000_r_0", "0001_r_0", "0002_r_2")


def test_links_and_dots_inside_the_root_are_fine(tiny):
    content = json.loads((tiny / "transforms_train.json").read_text())
    (tiny / "train/r_0.png").rename(tiny / "store.png")
    (tiny / "train/r_0.png").symlink_to("../store.png")
    content["frames"][1]["file_path"] = "test/../train/r_1"
    (tiny / "transforms_train.json").write_text(json.dumps(content))
    assert load(tiny).train.names == ("r_0", "r_1", "r_2")


def test_bounds_come_from_config_then_file(tiny):
    edit(tiny / "transforms_train.json", near=1.5, far=9)
    assert (load(tiny).near, load(tiny).far) == (1.5, 9.0)
    assert (load(tiny, near=3.0).near, load(tiny, far=4.0).far) == (3.0, 4.0)
    with pytest.raises(DataError, match=r"transforms_train\.json: found near 1\.5, far 1, expected near < far"):
        load(tiny, far=1.0)


def told(root: Path, **config) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load(root, **config)
    return [str(each.message) for each in caught]


def moved(root: Path, change) -> None:
    for split in ("train", "test"):
        path = root / f"transforms_{split}.json"
        frames = json.loads(path.read_text())["frames"]
        for frame in frames:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
        edit(path, frames=frames)


@pytest.mark.parametrize(
    ("times", "near", "far"), [(0.7, 1.4, 5.6), (0.8, 2, 6), (1.0, 2, 6), (1.2, 2, 6), (1.4, 2.8, 11.2), (10, 20, 80)]
)
def test_usual_bounds_are_held_against_the_cameras(tiny, times, near, far):
    """They stand at 4 by default; half to twice their distance is taken where 2 and 6 leave no room for an object."""
    moved(tiny, lambda pose: scaled(pose, times))
    scene = load(tiny)
    assert (scene.near, scene.far) == pytest.approx((near, far), rel=1e-5)
    said = [each for each in told(tiny) if "near 2 and far 6 do not suit cameras" in each]
    assert len(said) == (near != 2)
    assert all("dataset.near and dataset.far set them" in each for each in said)
    assert told(tiny, near=1, far=9) == []


def scaled(pose: np.ndarray, times: float) -> np.ndarray:
    return np.concatenate([pose[:, :3], pose[:, 3:] * [[times], [times], [times], [1]]], axis=1)


def test_cameras_that_do_not_look_at_one_point(tiny):
    moved(tiny, lambda pose: pose @ np.diag([-1.0, 1.0, -1.0, 1.0]))
    assert "2 and far 6 are Synthetic-NeRF's, and the cameras do not look at one point: dataset.near" in told(tiny)[0]
    assert "axes meet behind all cameras" in told(tiny)[1]


def test_light_of_a_rendering_counts_as_exposure(tiny):
    (tiny / "settings.json").write_text('{"light": 0.02}')
    assert load(tiny, exposure=0.5).exposure == pytest.approx(0.01)
    (tiny / "settings.json").write_text('{"editor": "other"}')
    assert load(tiny, exposure=0.5).exposure == 0.5


def test_depth_of_test_views(tmp_path):
    root = blender_layout(tmp_path / "deep", depth=True)
    code = np.stack([levels(root / f"test/r_{index}_depth.png") for index in range(2)])
    expected = np.where(code == 0, np.nan, code * 0.25).astype(np.float32)
    scene = load(root)
    assert scene.train.depth is None
    np.testing.assert_array_equal(scene.test.depth, expected)
    np.testing.assert_array_equal(load(root, downscale=2).test.depth, expected[:, 1::2, 1::2])


def test_lego(ctm_data):
    root = ctm_data / "lego_400"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        whole, dark = load(root, downscale=4), load(root, downscale=4, exposure=0.02)
    assert (whole.near, whole.far) == (2.0, 6.0)
    assert (whole.name, len(whole.train), len(whole.test)) == ("lego_400", 100, 25)
    assert whole.train.images.shape == (100, 100, 100, 4)
    focal = 50.0 / math.tan(json.loads((root / "transforms_train.json").read_text())["camera_angle_x"] / 2)
    assert focal == pytest.approx(138.9, abs=0.02)
    torch.testing.assert_close(whole.train.intrinsics[7], torch.tensor([focal, focal, 50.0, 50.0]))

    for index in (0, 50, 99):
        oracle = premultiplied_mean(levels(root / f"train/r_{index}.png"), 4)
        images = whole.train.images[index].numpy()
        oracle[np.rint(oracle[..., 3]) == 0] = 0
        # float32 against float64: a rounding may only fall the other way at a tie.
        assert np.abs(images - oracle).max() <= 0.5 + 1e-3

    assert (dark.exposure, dark.dark, whole.dark) == (0.02, True, False)
    # sRGB(0.02) = 0.1517 is 38.7 of 255.
    assert 36 <= dark.train.images[..., :3].max() <= 39
    for split in ("train", "test"):
        assert torch.equal(getattr(dark, split).images[..., 3], getattr(whole, split).images[..., 3])
