"""The Blender layout: what is read from good data sets, tiny and real."""

import json
import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.errors import ConfigError, DataError


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


def test_root_may_be_a_string_and_relative(tiny, monkeypatch):
    monkeypatch.chdir(tiny)
    assert load(".").name == "tiny"


def test_suffix_may_be_given_and_other_splits_lie_there(tiny):
    content = json.loads((tiny / "transforms_train.json").read_text())
    for frame in content["frames"]:
        frame["file_path"] += ".png"
    (tiny / "transforms_train.json").write_text(json.dumps(content))
    (tiny / "transforms_val.json").write_text("never read")
    assert load(tiny).train.names == ("r_0", "r_1", "r_2")


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


def test_pictures_without_alpha(tmp_path, write_blender):
    root = write_blender(tmp_path / "rgb", channels=3)
    assert load(root).train.images.shape == (3, 8, 8, 3)
    with pytest.raises(ConfigError, match=r"dataset\.background: found 'random_matched', expected .*no alpha"):
        load(root, background="random_matched")


def test_an_image_without_alpha_among_others_is_opaque(tiny):
    Image.open(tiny / "train/r_1.png").convert("RGB").save(tiny / "train/r_1.png")
    images = load(tiny, background="random_matched").train.images
    assert (images[1, ..., 3] == 255).all()
    assert not (images[0, ..., 3] == 255).all()


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


def test_frames_of_a_moving_scene(tiny):
    content = json.loads((tiny / "transforms_train.json").read_text())
    for index, frame in enumerate(content["frames"]):
        frame |= {"rotation": 0.1, "time": index / 3}
    edit(tiny / "transforms_train.json", **content)
    assert ["what 'time' say is not known" in each for each in told(tiny)] == [True]


def test_light_of_a_rendering_counts_as_exposure(tiny):
    (tiny / "settings.json").write_text('{"light": 0.02}')
    assert load(tiny, exposure=0.5).exposure == pytest.approx(0.01)
    (tiny / "settings.json").write_text('{"editor": "other"}')
    assert load(tiny, exposure=0.5).exposure == 0.5


def test_depth_of_test_views(tmp_path, write_blender):
    root = write_blender(tmp_path / "deep", depth=True)
    code = np.stack([levels(root / f"test/r_{index}_depth.png") for index in range(2)])
    expected = np.where(code == 0, np.nan, code * 0.25).astype(np.float32)
    scene = load(root)
    assert scene.train.depth is None
    np.testing.assert_array_equal(scene.test.depth, expected)
    np.testing.assert_array_equal(load(root, downscale=2).test.depth, expected[:, 1::2, 1::2])


def test_dark_scenes_are_told_apart(tmp_path, write_blender):
    root = write_blender(tmp_path / "tiny")
    assert not load(root).dark
    scene = load(root, exposure=0.02)
    assert scene.dark
    assert scene.dark is scene.dark
    assert load(write_blender(tmp_path / "rgb", channels=3), exposure=0.02).dark


def test_dark_ignores_what_alpha_hides_and_survives_nothing_at_all(tmp_path, write_blender):
    root = write_blender(tmp_path / "tiny")
    for path in (root / "train").iterdir():
        Image.fromarray(np.full((8, 8, 4), [255, 255, 255, 0], dtype=np.uint8)).save(path)
    assert load(root).dark


def test_lego(ctm_data, shrink_oracle):
    root = ctm_data / "lego_400"
    assert told(root, downscale=40) == []
    assert (load(root, downscale=40).near, load(root, downscale=40).far) == (2.0, 6.0)
    whole, dark = load(root, downscale=4), load(root, downscale=4, exposure=0.02)
    assert (whole.name, len(whole.train), len(whole.test)) == ("lego_400", 100, 25)
    assert whole.train.images.shape == (100, 100, 100, 4)
    focal = 50.0 / math.tan(json.loads((root / "transforms_train.json").read_text())["camera_angle_x"] / 2)
    assert focal == pytest.approx(138.9, abs=0.02)
    torch.testing.assert_close(whole.train.intrinsics[7], torch.tensor([focal, focal, 50.0, 50.0]))

    for index in (0, 50, 99):
        oracle = shrink_oracle(levels(root / f"train/r_{index}.png"), 4)
        images = whole.train.images[index].numpy()
        oracle[np.rint(oracle[..., 3]) == 0] = 0
        # float32 against float64: a rounding may only fall the other way at a tie.
        assert np.abs(images - oracle).max() <= 0.5 + 1e-3

    assert (dark.exposure, dark.dark, whole.dark) == (0.02, True, False)
    # sRGB(0.02) = 0.1517 is 38.7 of 255.
    assert 36 <= dark.train.images[..., :3].max() <= 39
    for split in ("train", "test"):
        assert torch.equal(getattr(dark, split).images[..., 3], getattr(whole, split).images[..., 3])
