"""Every fault of a data set is told in one line that names the file, what was found and what was expected."""

import json
import math
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from ctm_plugin.data import develop
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.data.transforms import TransformsConfig
from ctm_plugin.errors import CTMError, DataError

TRAIN = "transforms_train.json"
TEST = "transforms_test.json"


def fault(root: Path) -> str:
    with pytest.raises(DataError) as caught:
        BlenderConfig(root=root).load()
    message = str(caught.value)
    assert "found" in message
    assert "expected" in message
    assert "\n" not in message
    return message


def change(root: Path, do: Callable[[dict[str, Any]], object], name: str = TRAIN) -> None:
    content = json.loads((root / name).read_text())
    do(content)
    (root / name).write_text(json.dumps(content))


def pose(content: dict[str, Any], index: int = 1) -> list[list[Any]]:
    return content["frames"][index]["transform_matrix"]


def scale_rotation(matrix: list[list[float]], factors: tuple[float, float, float]) -> None:
    for row in matrix[:3]:
        row[:3] = [value * factor for value, factor in zip(row, factors, strict=False)]


def test_missing_root(tmp_path):
    assert fault(tmp_path / "none").startswith(f"{tmp_path / 'none'}: found nothing there, expected a folder with")


def test_empty_root(tmp_path):
    assert "found an empty folder" in fault(tmp_path)


def test_root_is_a_file(tmp_path):
    (tmp_path / "file").write_text("x")
    assert "found a file, expected a folder with" in fault(tmp_path / "file")


@pytest.mark.parametrize("root", ["a\0b", "~no_such_user/x", "x" * 300])
def test_root_that_cannot_be_a_path(root):
    with pytest.raises(DataError):
        BlenderConfig(root=root).load()


@pytest.mark.parametrize("name", [TRAIN, TEST])
class TestFiles:
    def test_missing(self, tiny, name):
        (tiny / name).unlink()
        assert f"expected a folder with {TRAIN} and {TEST}; dataset=transforms reads what is there" in fault(tiny)

    def test_folder_in_its_place(self, tiny, name):
        (tiny / name).unlink()
        (tiny / name).mkdir()
        assert f"{name}: found something that is not a file" in fault(tiny)

    def test_pipe_in_its_place(self, tiny, name):
        (tiny / name).unlink()
        os.mkfifo(tiny / name)
        assert f"{name}: found something that is not a file" in fault(tiny)

    @pytest.mark.parametrize("text", ["{", "nonsense", "[" * 100_000, '{"a": 1' + "0" * 5000 + "}", "\x00"])
    def test_not_json(self, tiny, name, text):
        (tiny / name).write_text(text)
        assert f"{name}: found something that is not JSON" in fault(tiny)

    @pytest.mark.parametrize(
        ("text", "found"),
        [
            ("", "an empty file"),
            ("version https://git-lfs.github.com/spec/v1\noid sha256:1\nsize 9", "a Git LFS pointer"),
        ],
    )
    def test_not_fetched(self, tiny, name, text, found):
        (tiny / name).write_text(text)
        assert f"{name}: found {found}" in fault(tiny)

    def test_not_text(self, tiny, name):
        (tiny / name).write_bytes(b"\xff\xfe\xfa\x80{")
        assert f"{name}: found something that is not JSON" in fault(tiny)

    @pytest.mark.parametrize("text", ["[]", "3", "null", '"text"'])
    def test_not_an_object(self, tiny, name, text):
        (tiny / name).write_text(text)
        assert "expected a JSON object" in fault(tiny)

    @pytest.mark.parametrize("key", ["camera_angle_x", "frames"])
    def test_key_missing(self, tiny, name, key):
        change(tiny, lambda content: content.pop(key), name)
        assert f"{name}: found no '{key}', expected " in fault(tiny)

    @pytest.mark.parametrize("key", ["file_path", "transform_matrix"])
    def test_frame_key_missing(self, tiny, name, key):
        change(tiny, lambda content: content["frames"][1].pop(key), name)
        assert f"{name}: found no 'frames[1].{key}', expected " in fault(tiny)


@pytest.mark.parametrize("frames", [[], {}, None, "x", 3, [3], [[]], [None]])
def test_frames_of_a_wrong_kind(tiny, frames):
    change(tiny, lambda content: content.update(frames=frames))
    assert f"{TRAIN}: found frames" in fault(tiny)


@pytest.mark.parametrize("angle", [0, -1, 5e-324, math.pi, 4, "x", math.nan, math.inf, None, True, [1], 10**400])
def test_camera_angle(tiny, angle):
    change(tiny, lambda content: content.update(camera_angle_x=angle))
    message = fault(tiny)
    assert f"{TRAIN}: found camera_angle_x = " in message
    assert "expected the field of view in radians, in (0, pi)" in message


@pytest.mark.parametrize("value", ["x", None, True, math.nan, math.inf, -math.inf, 1e39, 10**400, [1.0]])
@pytest.mark.parametrize("place", [(0, 0), (2, 3), (3, 3)])
def test_pose_entries(tiny, value, place):
    def spoil(content):
        pose(content)[place[0]][place[1]] = value

    change(tiny, spoil)
    assert "in frames[1].transform_matrix, expected 4 rows of 4 finite numbers" in fault(tiny)


@pytest.mark.parametrize(
    "matrix", [None, [], 3, [[1, 0, 0, 0]] * 2, [[1, 0, 0]] * 4, [[1, 0, 0, 0]] * 3 + [[]], ["abcd"] * 4]
)
def test_pose_shape(tiny, matrix):
    change(tiny, lambda content: content["frames"][1].update(transform_matrix=matrix))
    assert "found frames[1].transform_matrix = " in fault(tiny)


@pytest.mark.parametrize(
    "factors", [(1.01, 1.01, 1.01), (0.5, 0.5, 0.5), (1, 1, 2), (0, 0, 0), (-1, 1, 1), (-1, -1, -1)]
)
def test_pose_that_is_no_rotation(tiny, factors):
    change(tiny, lambda content: scale_rotation(pose(content), factors))
    message = fault(tiny)
    assert f"{TRAIN}: found frames[1].transform_matrix whose 3x3 part" in message
    assert "expected a rotation: orthonormal to 0.001, determinant +1" in message


def test_pose_with_a_small_rounding_error_is_fine(tiny):
    change(tiny, lambda content: scale_rotation(pose(content), (1.0003, 1, 1)))
    BlenderConfig(root=tiny).load()


def test_pose_with_another_last_row(tiny):
    change(tiny, lambda content: pose(content).__setitem__(3, [0, 0, 0, 2]))
    assert "expected 0 0 0 1 in the last row" in fault(tiny)


@pytest.mark.parametrize("name", ["/etc/hostname", "../outside", "..", "train/../../outside.png", "a\0b", "x" * 5000])
def test_paths_out_of_the_root(tiny, name):
    Image.new("RGBA", (8, 8)).save(tiny.parent / "outside.png")
    change(tiny, lambda content: content["frames"][1].update(file_path=name))
    message = fault(tiny)
    assert TRAIN in message or name.startswith("x")


def test_absolute_path_to_a_good_image_is_refused(tiny):
    outside = tiny.parent / "outside.png"
    Image.new("RGBA", (8, 8)).save(outside)
    change(tiny, lambda content: content["frames"][1].update(file_path=str(outside)))
    assert f"{TRAIN}: found path {str(outside)!r}, which leads outside {tiny}" in fault(tiny)


def test_more_than_an_angle_is_not_ignored(tiny):
    change(tiny, lambda content: content.update(cx=0, k1=0.0, rolling_shutter=[0, 0, 0, 0], w=8))  # which say nothing
    BlenderConfig(root=tiny).load()
    change(tiny, lambda content: content["frames"][1].update(k1=0.1))
    assert f"{TRAIN}: found frames[1].k1 = 0.1, expected only camera_angle_x" in fault(tiny)
    change(tiny, lambda content: content.update(cx=3.5))
    assert f"{TRAIN}: found cx = 3.5, expected only camera_angle_x in this layout: dataset=transforms" in fault(tiny)


def test_link_in_a_circle(tiny):
    (tiny / "train/r_1.png").unlink()
    (tiny / "train/r_1.png").symlink_to("r_1.png")
    assert "r_1" in fault(tiny)


@pytest.mark.parametrize(("split", "count"), [("train", 3), ("test", 2)])
def test_missing_image(tiny, split, count):
    (tiny / f"{split}/r_1.png").unlink()
    found = f"transforms_{split}.json: found 1 of {count} pictures missing, such as './{split}/r_1'"
    assert f"{found}, expected all; dataset=transforms leaves training" in fault(tiny)


def test_no_test_picture_at_all(tiny):
    """As BlenderNeRF leaves it: what the message names does read it."""
    shutil.rmtree(tiny / "test")
    assert "found 2 of 2 pictures missing" in fault(tiny)
    with pytest.warns(UserWarning, match="2 of 2 test views have no picture to score against"):
        assert not TransformsConfig(root=tiny, near=2, far=6).load().test.pictured.any()


@pytest.mark.parametrize("name", ["", 3, None, [], {}, True])
def test_file_path_of_a_wrong_kind(tiny, name):
    change(tiny, lambda content: content["frames"][1].update(file_path=name))
    assert "found frames[1].file_path = " in fault(tiny)


def test_folder_in_an_images_place(tiny):
    (tiny / "train/r_1.png").unlink()
    (tiny / "train/r_1.png").mkdir()
    assert "found 1 of 3 pictures missing, such as './train/r_1'" in fault(tiny)


@pytest.mark.parametrize("part", [0.0, 0.3, 0.9])
def test_truncated_image(tiny, part):
    content = (tiny / "train/r_1.png").read_bytes()
    (tiny / "train/r_1.png").write_bytes(content[: int(part * len(content))])
    assert "r_1.png: found " in fault(tiny)


def test_text_in_an_images_place(tiny):
    (tiny / "train/r_1.png").write_text("hello")
    assert "r_1.png: found something that is not an image, expected a whole image" in fault(tiny)


def test_image_of_another_size(tiny):
    Image.new("RGBA", (8, 6)).save(tiny / "train/r_1.png")
    with pytest.warns(UserWarning, match=r"transforms_train\.json: pictures of 2 sizes \(8x6, 8x8\)"):
        assert BlenderConfig(root=tiny).load().train.mask.flatten(1).sum(1).tolist() == [64, 48, 64]


@pytest.mark.parametrize("name", [TRAIN, "train/r_1.png"])
@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_no_permission(tiny, name):
    (tiny / name).chmod(0)
    assert f"{name.split('/')[-1]}: found " in fault(tiny)


def test_no_permission_to_read_json(tiny, monkeypatch):
    def refuse(path: Path) -> bytes:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "read_bytes", refuse)
    assert f"{TRAIN}: found a file that cannot be read (Permission denied)" in fault(tiny)


def test_no_permission_to_read_images(tiny, monkeypatch):
    def refuse(path: Path, **_: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Image, "open", refuse)
    assert "r_0.png: found an image that cannot be read (Permission denied)" in fault(tiny)


def test_more_pictures_than_fit_into_memory(tiny, monkeypatch):
    """One small file listed often enough would fill it."""
    monkeypatch.setattr(develop, "memory", lambda: 3 * 8 * 8 * 4)
    BlenderConfig(root=tiny).load()
    monkeypatch.setattr(develop, "memory", lambda: 3 * 8 * 8 * 4 - 1)
    assert "train: found 3 pictures of 8x8, 0 GiB, expected less than the 0 GiB of this machine" in fault(tiny)


@pytest.mark.parametrize(("pixels", "threads"), [(8 * 8 - 1, 1), (8 * 8, 1), (2 * 8 * 8, 2)])
def test_large_pictures_are_read_one_after_another(tiny, monkeypatch, pixels, threads):
    seen = []
    monkeypatch.setattr(develop, "MAX_PIXELS", pixels)
    monkeypatch.setattr(develop.os, "cpu_count", lambda: 4)
    pool = develop.ThreadPoolExecutor
    monkeypatch.setattr(develop, "ThreadPoolExecutor", lambda count: seen.append(count) or pool(count))
    BlenderConfig(root=tiny).load()
    assert seen == [threads] * 2


@pytest.mark.parametrize("scale", [0, -1, "x", None, math.nan, math.inf])
def test_depth_scale(tmp_path, write_blender, scale):
    root = write_blender(tmp_path / "deep", depth=True)
    change(root, lambda content: content.update(depth_scale=scale), TEST)
    assert f"{TEST}: found depth_scale = " in fault(root)


def test_missing_depth(tmp_path, write_blender):
    root = write_blender(tmp_path / "deep", depth=True)
    change(root, lambda content: content["frames"][1].pop("depth_file_path"), TEST)
    assert f"{TEST}: found no 'frames[1].depth_file_path'" in fault(root)


def test_depth_of_another_size(tmp_path, write_blender):
    root = write_blender(tmp_path / "deep", depth=True)
    Image.new("I;16", (4, 4)).save(root / "test/r_1_depth.png")
    assert "r_1_depth.png: found depth of 4x4 pixels, expected 8x8 as the images" in fault(root)


@pytest.mark.parametrize("text", ["[]", "{", '{"light": 0}', '{"light": "x"}'])
def test_spoilt_render_settings(tiny, text):
    (tiny / "settings.json").write_text(text)
    assert "settings.json: found " in fault(tiny)


ANY_JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([10**400, -(10**400), 2**63, 0, 1])
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["..", "/", "~", "\0", "\ud800", "./train/r_0", "x" * 5000]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)


def nodes(value: Any, path: tuple = ()) -> list[tuple]:
    """Paths of all values inside ``value``."""
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path] * bool(path) + [found for key, child in children for found in nodes(child, (*path, key))]


@pytest.fixture(scope="module")
def deep(tmp_path_factory, write_blender) -> Path:
    """A data set with depth, shared by all examples: only its JSON changes, and each example writes it anew."""
    return write_blender(tmp_path_factory.mktemp("mutated") / "deep", depth=True)


@pytest.fixture(scope="module")
def originals(deep) -> dict[str, str]:
    return {name: (deep / name).read_text() for name in (TRAIN, TEST)}


@settings(max_examples=100)
@given(data=st.data())
def test_mutated_json_loads_or_is_refused(deep, originals, data):
    for name, text in originals.items():
        (deep / name).write_text(text)
    name = data.draw(st.sampled_from([TRAIN, TEST]))
    content = json.loads(originals[name])
    for _ in range(data.draw(st.integers(1, 3))):
        places = nodes(content)
        if not places:
            break
        *parents, last = data.draw(st.sampled_from(places))
        owner = content
        for key in parents:
            owner = owner[key]
        if data.draw(st.booleans()):
            del owner[last]
        else:
            owner[last] = data.draw(ANY_JSON)
    (deep / name).write_text(json.dumps(content))
    try:
        scene = BlenderConfig(root=deep, skip=data.draw(st.integers(1, 4))).load()
    except CTMError:
        return
    for views in (scene.train, scene.test):
        assert views.c2w.isfinite().all()
        assert views.intrinsics.isfinite().all()


@settings(max_examples=50)
@given(data=st.data())
def test_damaged_json_loads_or_is_refused(deep, originals, data):
    for name, text in originals.items():
        (deep / name).write_text(text)
    name = data.draw(st.sampled_from([TRAIN, TEST]))
    content = bytearray(originals[name].encode())
    for _ in range(data.draw(st.integers(0, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    (deep / name).write_bytes(content[: data.draw(st.integers(len(content) - 20, len(content)))])
    with suppress(CTMError):
        BlenderConfig(root=deep).load()
