"""Files of key frames: what is read of them, and what is refused."""

import json
import math

import numpy as np
import pytest

from ctm_plugin.data.readers.camera_path import read_key_frames
from ctm_plugin.errors import DataError
from ctm_plugin.scene.camera_paths import KeyFrames

KEY = {"camera_to_world": np.eye(3, 4).tolist(), "fov": 40}


def test_what_is_written_is_read(tmp_path):
    poses = np.stack([np.eye(3, 4), np.eye(3, 4)])
    poses[:, 2, 3] = 1 / 3
    keys = KeyFrames(poses, np.array([0.5, 1.0]), closed=True, lit=(5.2, 1.1, 0.0))
    path = tmp_path / "path.json"
    path.write_text(json.dumps(keys.content()))
    again = read_key_frames(path)
    np.testing.assert_array_equal(again.c2w, keys.c2w)
    np.testing.assert_allclose(again.fov, keys.fov, rtol=4 * np.finfo(float).eps)
    assert (again.closed, again.lit) == (True, (5.2, 1.1, 0.0))


def test_open_unless_it_says_otherwise(tmp_path):
    (tmp_path / "path.json").write_text(json.dumps({"keys": [KEY]}))
    read = read_key_frames(tmp_path / "path.json")
    assert (read.closed, read.lit) == (False, None)
    assert read.fov == pytest.approx([math.radians(40)])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([KEY, KEY], "found a JSON list, expected a JSON object"),
        ({}, "found no 'keys'"),
        ({"keys": []}, "found keys ="),
        ({"keys": [KEY], "closed": 1}, "found closed = 1, expected an object of keys"),
        ({"keys": [KEY], "fps": 10}, "found an unknown key 'fps'"),
        ({"keys": [KEY], "light": 1}, "found no 'contrast'"),
        ({"keys": [KEY], "light": "auto", "contrast": 1, "saturation": 1}, r"found light = .auto., .* in \[-10, 10\]"),
        ({"keys": [KEY], "light": 1, "contrast": 3, "saturation": 1}, r"found contrast = 3, .* in \[0.5, 2\]"),
        ({"keys": [KEY | {"roll": 1}]}, r"found an unknown key 'keys\[0\].roll'"),
        ({"keys": [KEY, KEY | {"fov": 180}]}, r"found keys\[1\].fov = 180, expected degrees in \(0, 180\)"),
        ({"keys": [KEY | {"fov": math.nan}]}, r"found keys\[0\].fov = nan"),
        ({"keys": [KEY | {"camera_to_world": np.eye(4).tolist()}]}, "3 rows of 4 finite numbers"),
        ({"keys": [KEY | {"camera_to_world": (2 * np.eye(3, 4)).tolist()}]}, r"found keys\[0\].camera_to_world whose"),
        ({"keys": [KEY | {"camera_to_world": (-np.eye(3, 4)).tolist()}]}, "mirrors"),
    ],
)
def test_refused(tmp_path, values, message):
    (tmp_path / "path.json").write_text(json.dumps(values))
    with pytest.raises(DataError, match=message):
        read_key_frames(tmp_path / "path.json")


@pytest.mark.parametrize("content", [b"{", b"\xff", b"[" * 100_000])
def test_no_json(tmp_path, content):
    (tmp_path / "path.json").write_bytes(content)
    with pytest.raises(DataError, match="something that is not JSON"):
        read_key_frames(tmp_path / "path.json")
