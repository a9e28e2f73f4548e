"""The order of work of the renderer, with a stand-in for Blender that paints flat pictures."""

import errno
import hashlib
import json
import math

import imageio.v3 as iio
import numpy as np
import pytest
from stand_in import TABLE

from ctm_plugin.cli import main
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.errors import ConfigError, DataError, UnknownNameError
from ctm_plugin.scenes import render
from ctm_plugin.scenes.encode import DEPTH_SCALE, write_png
from ctm_plugin.scenes.settings import RenderSettings

TINY = {"width": 16, "samples": 1}
SMALL = RenderSettings(**TINY, views=3, test_views=2)


@pytest.fixture
def blend(tmp_path):
    path = tmp_path / "kitchen.blend"
    path.write_bytes(b"BLENDER")
    return path


def names(folder) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_files_of_a_rendering(painter, tmp_path):
    render.render("table", tmp_path / "out", SMALL)
    expected = ["README.md", "SHA256SUMS", "settings.json"]
    expected += ["test/r_0.png", "test/r_0_depth.npy", "test/r_1.png", "test/r_1_depth.npy"]
    expected += ["train/r_0.png", "train/r_1.png", "train/r_2.png", "transforms_test.json", "transforms_train.json"]
    assert names(tmp_path / "out") == expected
    assert iio.imread(tmp_path / "out/train/r_2.png")[0, [0, 15]].tolist() == [[188, 188, 188, 255], [0, 0, 0, 0]]
    depth = np.load(tmp_path / "out/test/r_1_depth.npy")
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth[0, [0, 15]], [4.0, np.nan])

    train, test = (json.loads((tmp_path / f"out/transforms_{split}.json").read_text()) for split in ("train", "test"))
    assert train["camera_angle_x"] == test["camera_angle_x"] == TABLE.camera_angle_x
    assert (train["near"], train["far"]) == (TABLE.near, TABLE.far)
    assert [frame["file_path"] for frame in train["frames"]] == [f"./train/r_{i}" for i in range(3)]
    assert [frame["depth_file_path"] for frame in test["frames"]] == [f"./test/r_{i}_depth.npy" for i in range(2)]
    assert test["depth_scale"] == 1.0
    np.testing.assert_array_equal([frame["transform_matrix"] for frame in train["frames"]], TABLE.train(3, 0))
    np.testing.assert_array_equal([frame["transform_matrix"] for frame in test["frames"]], TABLE.test(2, 0))

    settings = json.loads((tmp_path / "out/settings.json").read_text())
    assert settings == {
        "scene": "table", "light": 1.0, "width": 16, "height": 16, "samples": 1, "denoise": True, "seed": 0,
        "views": 3, "test_views": 2, "trajectory": "own", "extent": 0.2, "background": "own",
        "depth": "float", "depth_scale": 1.0, "blender": "stand-in",
    }  # fmt: skip


def test_the_manifest_tells_settings_and_hashes(painter, tmp_path):
    render.render("table", tmp_path, SMALL)
    sums = (tmp_path / "SHA256SUMS").read_text()
    told = dict(reversed(line.split("  ")) for line in sums.splitlines())
    assert sorted(told) == [name for name in names(tmp_path) if name not in ("README.md", "SHA256SUMS")]
    for name, digest in told.items():
        assert hashlib.sha256((tmp_path / name).read_bytes()).hexdigest() == digest
    page = (tmp_path / "README.md").read_text()
    assert hashlib.sha256(sums.encode()).hexdigest() in page
    assert "| light | 1.0 |" in page


def test_depth_as_codes(painter, tmp_path):
    render.render("table", tmp_path / "float", SMALL)
    render.render("table", tmp_path / "code", RenderSettings(**TINY, views=3, test_views=2, depth="code"))
    code = iio.imread(tmp_path / "code/test/r_1_depth.png")
    assert code[0, [0, 15]].tolist() == [4.0 / DEPTH_SCALE, 0]
    left, right = (BlenderConfig(root=tmp_path / kind).load().test.depth for kind in ("float", "code"))
    np.testing.assert_array_equal(left, right)
    np.testing.assert_array_equal(left[0, 0, [0, 15]], [4.0, np.nan])


def test_a_blend_file_from_its_own_camera(painter, tmp_path, blend):
    render.render(str(blend), tmp_path / "out", RenderSettings(width=24, height=16, samples=1, views=9))
    assert names(tmp_path / "out")[3:7] == [f"depth/view_{i:03d}.npy" for i in (1, 2, 3, 4)]
    assert iio.imread(tmp_path / "out/images/view_008.png").shape == (16, 24, 3)
    rows = np.load(tmp_path / "out/poses_bounds.npy")
    assert rows.shape == (9, 17)
    matrix = rows[4, :15].reshape(3, 5)
    np.testing.assert_allclose(matrix[:, 4], [16, 24, 12 / math.tan(0.4)])
    # The grid has a fifth of the distance as its edge, and every camera looks where the file's own does.
    eyes = rows[:, 3:15:5]
    assert np.linalg.norm(eyes - [0.0, -5.0, 1.0], axis=1).max() < 0.2 * 4.0 / math.sqrt(2)
    target = np.array([0.0, -5.0, 1.0]) * (1 - 4.0 / math.sqrt(26))
    for eye, down, right in zip(eyes, rows[:, 0:15:5], rows[:, 1:15:5], strict=True):
        back = np.cross(right, -down)
        np.testing.assert_allclose(eye - np.linalg.norm(eye - target) * back, target, atol=1e-9)
    # Bounds are depths along the axis: distance 4 at the picture's left edge is less than 4.
    assert (rows[:, 15] < rows[:, 16]).all()
    assert (rows[:, 16] < 4.0).all()
    settings = json.loads((tmp_path / "out/settings.json").read_text())
    assert settings["scene"] == f"kitchen.blend sha256 {hashlib.sha256(b'BLENDER').hexdigest()}"


def test_a_blend_file_from_all_around(painter, tmp_path, blend):
    render.render(str(blend), tmp_path / "out", RenderSettings(**TINY, views=2, test_views=1, trajectory="hemisphere"))
    train = json.loads((tmp_path / "out/transforms_train.json").read_text())
    for frame in train["frames"]:
        eye = np.array(frame["transform_matrix"])[:3, 3]
        assert np.linalg.norm(eye) == pytest.approx(math.sqrt(26))
    assert (train["near"], train["far"]) == (pytest.approx(3.6), pytest.approx(4.4))
    assert iio.imread(tmp_path / "out/train/r_1.png").shape == (16, 16, 4)


def test_the_cameras_of_a_data_set_are_followed(painter, tmp_path, blend):
    render.render("table", tmp_path / "first", SMALL)
    followed = RenderSettings(**TINY, trajectory=str(tmp_path / "first"))
    render.render(str(blend), tmp_path / "second", followed)
    for split in ("train", "test"):
        first, second = (
            json.loads((tmp_path / name / f"transforms_{split}.json").read_text()) for name in ("first", "second")
        )
        assert first == second


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"trajectory": "forward"}, ConfigError, "trajectory: found 'forward', expected own or a folder"),
        ({"trajectory": "no/such"}, DataError, r"transforms_test\.json"),
    ],
)
def test_trajectories_that_cannot_be(painter, tmp_path, settings, error, message):
    with pytest.raises(error, match=message):
        render.render("table", tmp_path / "out", RenderSettings(**settings))
    assert not (tmp_path / "out").exists()


def test_unknown_scene(painter, tmp_path):
    with pytest.raises(UnknownNameError, match=r"unknown scene 'lego'; known: .*table"):
        render.render("lego", tmp_path / "out", SMALL)


@pytest.mark.parametrize("stop_after", range(7))
def test_a_stopped_rendering_goes_on(painter, tmp_path, stop_after):
    painter.stop_after = stop_after
    with pytest.raises(KeyboardInterrupt):
        render.render("table", tmp_path, SMALL)
    assert len(names(tmp_path)) == 1 + stop_after
    painter.stop_after = None
    render.render("table", tmp_path, SMALL)
    assert painter.taken == 7
    render.render("table", tmp_path, SMALL)
    assert painter.taken == 7


def test_another_rendering_is_refused(painter, tmp_path):
    render.render("table", tmp_path, SMALL)
    before = names(tmp_path)
    other = RenderSettings(**TINY, light=0.5, views=3, test_views=2, seed=1)
    with pytest.raises(DataError, match=r"a rendering with light=1\.0, seed=0, expected one with light=0\.5, seed=1"):
        render.render("table", tmp_path, other)
    assert names(tmp_path) == before


@pytest.mark.parametrize("content", ["", "not json", "3", "[1]"])
def test_unreadable_settings(painter, tmp_path, content):
    (tmp_path / "settings.json").write_text(content)
    with pytest.raises(DataError, match=r"settings\.json: found no settings"):
        render.render("table", tmp_path, SMALL)


def test_a_folder_of_other_things_is_refused(painter, tmp_path):
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(DataError, match=r"found files but no settings\.json"):
        render.render("table", tmp_path, SMALL)
    with pytest.raises(DataError, match="found a file, expected a folder"):
        render.render("table", tmp_path / "thesis.tex", SMALL)


def test_a_full_disk_keeps_what_is_finished(painter, tmp_path, capsys):
    written = []

    def write(path, image):
        if len(written) == 2:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        written.append(path)
        write_png(path, image)

    command = ["scenes", "table", f"out={tmp_path / 'out'}", "width=16", "samples=1", "views=3", "test_views=2"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(render, "write_png", write)
        assert main(command) == 1
    assert "No space left on device" in capsys.readouterr().err
    assert names(tmp_path / "out") == ["settings.json", "train/r_0.png", "train/r_1.png"]
    assert main(command) == 0
    assert painter.taken == 3 + 5
