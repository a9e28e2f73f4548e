"""The order of work of the renderer, with a stand-in for Blender that paints flat pictures."""

import contextlib
import json
from types import SimpleNamespace

import imageio.v3 as iio
import numpy as np
import pytest

from ctm_plugin.errors import DataError
from ctm_plugin.scenes import SCENES, render
from ctm_plugin.scenes.encode import DEPTH_SCALE
from ctm_plugin.scenes.render import RenderSettings

SCENE = SCENES["still_life"]
SMALL = RenderSettings(size=16, samples=1, views=3, test_views=2)


class Painter:
    """Stands in for ``ctm_plugin.scenes.blender``: flat grey or distance 4 in the left half, nothing on the right."""

    def __init__(self):
        self.taken = 0
        self.stop_after = None

    def __getattr__(self, name):
        return lambda *_: None

    def require_bpy(self):
        return SimpleNamespace(app=SimpleNamespace(version_string="stand-in"))

    def quiet(self):
        return contextlib.nullcontext()

    def set_up_cycles(self, size, *_):
        self.size = size

    def use_radiance(self, *_):
        self.value = 0.5

    def use_distance(self):
        self.value = 4.0

    def picture(self):
        if self.taken == self.stop_after:
            raise KeyboardInterrupt
        self.taken += 1
        image = np.zeros((self.size, self.size, 4), dtype=np.float32)
        image[:, : self.size // 2] = [self.value, self.value, self.value, 1.0]
        return image


@pytest.fixture
def painter(monkeypatch) -> Painter:
    painter = Painter()
    monkeypatch.setattr(render, "blender", painter)
    return painter


def names(folder) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_files_of_a_rendering(painter, tmp_path):
    render.render(SCENE, tmp_path / "out", SMALL)
    expected = ["settings.json", "test/r_0.png", "test/r_0_depth.png", "test/r_1.png", "test/r_1_depth.png"]
    expected += ["train/r_0.png", "train/r_1.png", "train/r_2.png", "transforms_test.json", "transforms_train.json"]
    assert names(tmp_path / "out") == expected
    assert iio.imread(tmp_path / "out/train/r_2.png")[0, [0, 15]].tolist() == [[188, 188, 188, 255], [0, 0, 0, 0]]
    assert iio.imread(tmp_path / "out/test/r_1_depth.png")[0, [0, 15]].tolist() == [4.0 / DEPTH_SCALE, 0]

    train, test = (json.loads((tmp_path / f"out/transforms_{split}.json").read_text()) for split in ("train", "test"))
    assert train["camera_angle_x"] == test["camera_angle_x"] == SCENE.camera_angle_x
    assert (train["near"], train["far"]) == (SCENE.near, SCENE.far)
    assert [frame["file_path"] for frame in train["frames"]] == [f"./train/r_{i}" for i in range(3)]
    assert [frame["depth_file_path"] for frame in test["frames"]] == [f"./test/r_{i}_depth.png" for i in range(2)]
    assert test["depth_scale"] == DEPTH_SCALE
    np.testing.assert_array_equal([frame["transform_matrix"] for frame in train["frames"]], SCENE.train(3, 0))
    np.testing.assert_array_equal([frame["transform_matrix"] for frame in test["frames"]], SCENE.test(2, 0))

    settings = json.loads((tmp_path / "out/settings.json").read_text())
    assert settings == {
        "scene": "still_life", "light": 1.0, "size": 16, "samples": 1, "seed": 0, "views": 3, "test_views": 2,
        "blender": "stand-in",
    }  # fmt: skip


@pytest.mark.parametrize("stop_after", range(7))
def test_a_stopped_rendering_goes_on(painter, tmp_path, stop_after):
    painter.stop_after = stop_after
    with pytest.raises(KeyboardInterrupt):
        render.render(SCENE, tmp_path, SMALL)
    assert len(names(tmp_path)) == 1 + stop_after
    painter.stop_after = None
    render.render(SCENE, tmp_path, SMALL)
    assert painter.taken == 7
    render.render(SCENE, tmp_path, SMALL)
    assert painter.taken == 7


def test_another_rendering_is_refused(painter, tmp_path):
    render.render(SCENE, tmp_path, SMALL)
    before = names(tmp_path)
    other = RenderSettings(light=0.5, size=16, samples=1, views=3, test_views=2, seed=1)
    with pytest.raises(DataError, match=r"a rendering with light=1\.0, seed=0, expected one with light=0\.5, seed=1"):
        render.render(SCENE, tmp_path, other)
    assert names(tmp_path) == before


@pytest.mark.parametrize("content", ["", "not json", "3", "[1]"])
def test_unreadable_settings(painter, tmp_path, content):
    (tmp_path / "settings.json").write_text(content)
    with pytest.raises(DataError, match=r"settings\.json: found no settings"):
        render.render(SCENE, tmp_path, SMALL)


def test_a_folder_of_other_things_is_refused(painter, tmp_path):
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(DataError, match=r"found files but no settings\.json"):
        render.render(SCENE, tmp_path, SMALL)
    with pytest.raises(DataError, match="found a file, expected a folder"):
        render.render(SCENE, tmp_path / "thesis.tex", SMALL)
