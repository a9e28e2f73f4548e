"""Every fault of a data set is told in one line that names the file, what was found and what was expected."""

import json
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from ctm_plugin.data import develop
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.data.transforms import TransformsConfig
from ctm_plugin.errors import DataError

TRAIN = "transforms_train.json"
TEST = "transforms_test.json"


def fault(root: Path | str) -> str:
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


def frame(**values: Any) -> Callable[[dict[str, Any]], object]:
    return lambda content: content["frames"][1].update(values)


def entry(row: int, column: int, value: Any) -> Callable[[dict[str, Any]], object]:
    return lambda content: content["frames"][1]["transform_matrix"][row].__setitem__(column, value)


def scaled(*factors: float) -> Callable[[dict[str, Any]], object]:
    def scale(content: dict[str, Any]) -> None:
        for row in content["frames"][1]["transform_matrix"][:3]:
            row[:3] = [value * factor for value, factor in zip(row, factors, strict=False)]

    return scale


def without(*path: str | int) -> Callable[[dict[str, Any]], object]:
    *parents, last = path

    def drop(content: Any) -> None:
        for key in parents:
            content = content[key]
        content.pop(last)

    return drop


def test_roots(tmp_path):
    assert fault(tmp_path / "none").startswith(f"{tmp_path / 'none'}: found nothing there, expected a folder with")
    assert "found an empty folder" in fault(tmp_path)
    (tmp_path / "file").write_text("x")
    assert "found a file, expected a folder with" in fault(tmp_path / "file")
    for root in ("a\0b", "~no_such_user/x", "x" * 300):
        fault(root)


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def holds(text: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(text)


@pytest.mark.parametrize("name", [TRAIN, TEST])
@pytest.mark.parametrize(
    ("spoil", "found"),
    [
        (folder, "something that is not a file"),
        (pipe, "something that is not a file"),
        *((holds(text), "something that is not JSON") for text in ("{", "[" * 100_000, '{"a": 1' + "0" * 5000, "\x00")),
        (lambda path: path.write_bytes(b"\xff\xfe\xfa\x80{"), "something that is not JSON"),
        (holds(""), "an empty file"),
        (holds("version https://git-lfs.github.com/spec/v1\noid sha256:1\nsize 9"), "a Git LFS pointer"),
        *((holds(text), "a JSON .*, expected a JSON object") for text in ("[]", "3", "null", '"text"')),
    ],
)
def test_files(tiny, name, spoil, found):
    spoil(tiny / name)
    with pytest.raises(DataError, match=f"{name}: found {found}"):
        BlenderConfig(root=tiny).load()


@pytest.mark.parametrize("name", [TRAIN, TEST])
def test_a_file_that_is_missing(tiny, name):
    (tiny / name).unlink()
    assert f"expected a folder with {TRAIN} and {TEST}; dataset=transforms reads what is there" in fault(tiny)


FINITE = "expected 4 rows of 4 finite numbers"
TURN = "expected a rotation: orthonormal to 0.001, determinant +1"
NO_NUMBERS = ["x", None, True, math.nan, math.inf, [1.0], 10**400]


@pytest.mark.parametrize("name", [TRAIN, TEST])
@pytest.mark.parametrize(
    ("do", "found"),
    [
        *((without(key), f"found no '{key}', expected ") for key in ("camera_angle_x", "frames")),
        *((without("frames", 1, key), f"found no 'frames[1].{key}', ") for key in ("file_path", "transform_matrix")),
        *((lambda c, v=v: c.update(frames=v), "found frames") for v in ([], {}, None, "x", 3, [3], [[]], [None])),
        *(
            (lambda c, v=v: c.update(camera_angle_x=v), "expected the field of view in radians, in (0, pi)")
            for v in (0, -1, 5e-324, math.pi, 4, *NO_NUMBERS)
        ),
        *((entry(*at, v), f"in frames[1].transform_matrix, {FINITE}") for at in ((0, 0), (3, 3)) for v in NO_NUMBERS),
        *(
            (frame(transform_matrix=matrix), "found frames[1].transform_matrix = ")
            for matrix in (None, [], 3, [[1, 0, 0, 0]] * 2, [[1, 0, 0]] * 4, [[1, 0, 0, 0]] * 3 + [[]], ["abcd"] * 4)
        ),
        *((scaled(*each), TURN) for each in ((1.01,) * 3, (0.5,) * 3, (1, 1, 2), (0, 0, 0), (-1, 1, 1), (-1, -1, -1))),
        (lambda c: c["frames"][1]["transform_matrix"].__setitem__(3, [0, 0, 0, 2]), "expected 0 0 0 1 in the last row"),
        *((frame(file_path=path), "found frames[1].file_path = ") for path in ("", 3, None, [], {}, True)),
        *((frame(file_path=path), "expected") for path in ("..", "/etc/hosts", "a/../../b.png", "a\0b", "x" * 5000)),
        (frame(k1=0.1), "found frames[1].k1 = 0.1, expected only camera_angle_x in this layout: dataset=transforms"),
        (lambda c: c.update(cx=3.5), "found cx = 3.5, expected only camera_angle_x in this layout"),
    ],
)  # fmt: skip
def test_content(tiny, do, found, name):
    change(tiny, do, name)
    message = fault(tiny)
    assert found in message
    assert name in message or "x" * 5000 in message


@pytest.mark.parametrize("do", [scaled(1.0003, 1, 1), lambda c: c.update(cx=0, k1=0.0, rolling_shutter=[0, 0], w=8)])
def test_what_says_nothing_and_roundings_are_fine(tiny, do):
    change(tiny, do)
    BlenderConfig(root=tiny).load()


def test_absolute_path_to_a_good_image_is_refused(tiny):
    outside = tiny.parent / "outside.png"
    Image.new("RGBA", (8, 8)).save(outside)
    change(tiny, frame(file_path=str(outside)))
    assert f"{TRAIN}: found path {str(outside)!r}, which leads outside {tiny}" in fault(tiny)


def circle(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


@pytest.mark.parametrize(
    ("spoil", "found"),
    [
        (
            lambda path: path.unlink(),
            f"{TRAIN}: found 1 of 3 pictures missing, such as './train/r_1', expected all; data",
        ),
        (folder, f"{TRAIN}: found 1 of 3 pictures missing, such as './train/r_1'"),
        (circle, "r_1"),
        *((lambda path, n=n: path.write_bytes(path.read_bytes()[:n]), "r_1.png: found ") for n in (0, 90, 250)),
        (holds("hello"), "r_1.png: found something that is not an image, expected a whole image"),
    ],
)
def test_pictures(tiny, spoil, found):
    spoil(tiny / "train/r_1.png")
    assert found in fault(tiny)


def test_no_test_picture_at_all(tiny):
    """As BlenderNeRF leaves it: what the message names does read it."""
    shutil.rmtree(tiny / "test")
    assert f"{TEST}: found 2 of 2 pictures missing" in fault(tiny)
    with pytest.warns(UserWarning, match="2 of 2 test views have no picture to score against"):
        assert not TransformsConfig(root=tiny, near=2, far=6).load().test.pictured.any()


def test_image_of_another_size(tiny):
    Image.new("RGBA", (8, 6)).save(tiny / "train/r_1.png")
    with pytest.warns(UserWarning, match=r"transforms_train\.json: pictures of 2 sizes \(8x6, 8x8\)"):
        assert BlenderConfig(root=tiny).load().train.mask.flatten(1).sum(1).tolist() == [64, 48, 64]


def test_no_permission(tiny, monkeypatch):
    def refuse(path: Path, **_: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    with monkeypatch.context() as patched:
        patched.setattr(Path, "read_bytes", refuse)
        assert f"{TRAIN}: found a file that cannot be read (Permission denied)" in fault(tiny)
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


@pytest.mark.parametrize(
    ("do", "found"),
    [
        *(
            (lambda c, v=v: c.update(depth_scale=v), f"{TEST}: found depth_scale = ")
            for v in (0, -1, "x", None, math.nan, math.inf)
        ),
        (without("frames", 1, "depth_file_path"), f"{TEST}: found no 'frames[1].depth_file_path'"),
        (frame(depth_file_path="test/small"), "small.png: found depth of 4x4 pixels, expected 8x8 as the images"),
    ],
)
def test_depth(tmp_path, write_blender, do, found):
    root = write_blender(tmp_path / "deep", depth=True)
    Image.new("I;16", (4, 4)).save(root / "test/small.png")
    change(root, do, TEST)
    assert found in fault(root)


@pytest.mark.parametrize("text", ["[]", "{", '{"light": 0}', '{"light": "x"}'])
def test_spoilt_render_settings(tiny, text):
    (tiny / "settings.json").write_text(text)
    assert "settings.json: found " in fault(tiny)
