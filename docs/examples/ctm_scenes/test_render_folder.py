"""The order of work of the renderer, with a stand-in for Blender that paints flat pictures."""

import errno
import hashlib
import json
import math
import subprocess

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from ctm_scenes import layouts, render
from ctm_scenes.layouts import DEPTH_SCALE, decode_depth, encode_depth, to_rgba8, write_png
from ctm_scenes.settings import RenderSettings
from hypothesis import given
from hypothesis import strategies as st
from stand_in import TABLE

from ctm_plugin.cli import main
from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.errors import ConfigError, DataError

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
    scene = BlenderConfig(root=tmp_path / "out").load()
    assert (scene.near, scene.far) == (TABLE.near, TABLE.far)
    for views, poses in ((scene.train, TABLE.train(3, 0)), (scene.test, TABLE.test(2, 0))):
        np.testing.assert_allclose(views.c2w, poses[:, :3], atol=1e-6)
        np.testing.assert_allclose(views.intrinsics[:, 0], 8 / math.tan(TABLE.camera_angle_x / 2), rtol=1e-6)

    settings = json.loads((tmp_path / "out/settings.json").read_text())
    assert settings == {
        "scene": "table", "light": 1.0, "width": 16, "height": 16, "samples": 1, "denoise": True, "seed": 0,
        "views": 3, "test_views": 2, "trajectory": "own", "extent": 0.2, "background": "own",
        "depth": "float", "depth_scale": 1.0, "blender": "stand-in",
    }  # fmt: skip


def test_the_manifest_tells_settings_and_hashes(painter, tmp_path):
    render.render("table", tmp_path, SMALL)
    subprocess.run(["sha256sum", "-c", "--quiet", "SHA256SUMS"], cwd=tmp_path, check=True)
    sums, page = (tmp_path / "SHA256SUMS").read_bytes(), (tmp_path / "README.md").read_text()
    assert len(sums.splitlines()) == len(names(tmp_path)) - 2
    assert hashlib.sha256(sums).hexdigest() in page
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


@pytest.mark.parametrize("stop_after", [0, 4, 6])
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
    other = RenderSettings(**TINY, light=0.5, views=3, test_views=2, seed=1)
    with pytest.raises(DataError, match=r"a rendering with light=1\.0, seed=0, expected one with light=0\.5, seed=1"):
        render.render("table", tmp_path, other)
    assert painter.taken == 7


@pytest.mark.parametrize(
    ("file", "content", "found"),
    [("settings.json", text, r"settings\.json: found no settings") for text in ("", "not json", "3", "[1]")]
    + [("thesis.tex", "x", r"found files but no settings\.json")],
)
def test_a_folder_of_other_things_is_refused(painter, tmp_path, file, content, found):
    (tmp_path / file).write_text(content)
    with pytest.raises(DataError, match=found):
        render.render("table", tmp_path, SMALL)
    with pytest.raises(DataError, match="found a file, expected a folder"):
        render.render("table", tmp_path / file, SMALL)


def test_a_full_disk_keeps_what_is_finished(painter, tmp_path, capsys):
    written = []

    def write(path, image):
        if len(written) == 2:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        written.append(path)
        write_png(path, image)

    command = ["scenes", "table", f"out={tmp_path / 'out'}", "width=16", "samples=1", "views=3", "test_views=2"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(layouts, "write_png", write)
        assert main(command) == 1
    assert "No space left on device" in capsys.readouterr().err
    assert names(tmp_path / "out") == ["settings.json", "train/r_0.png", "train/r_1.png"]
    assert main(command) == 0
    assert painter.taken == 3 + 5


@given(st.floats(0.02, 1.0), st.floats(0.0, 1.0))
def test_alpha_is_straight(alpha, light):
    pixel = np.array([[[light * alpha, 0.0, alpha, alpha]]], dtype=np.float32)
    expected = [255.0 * linear_to_srgb(torch.tensor(light)).item(), 0.0, 255.0, 255.0 * alpha]
    np.testing.assert_allclose(to_rgba8(pixel)[0, 0], expected, atol=0.51)


@pytest.mark.parametrize(
    ("pixel", "expected"),
    [
        ([-1.0, 0.0, 7.0, 1.0], [0, 0, 255, 255]),
        ([0.0, 0.0, 0.0, 0.0], [0, 0, 0, 0]),
        ([1e-4, 1e-4, 1e-4, 1e-4], [0, 0, 0, 0]),
        ([0.3, 0.2, 0.1, -0.1], [0, 0, 0, 0]),
    ],
)
def test_light_is_cut_and_nothing_has_no_colour(pixel, expected):
    assert to_rgba8(np.array([[pixel]], dtype=np.float32)).tolist() == [[expected]]


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
