"""Files of key frames, as the viewer saves them and ``render path=FILE`` films them."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from ctm_plugin.data.readers.folders import read_bytes, told
from ctm_plugin.data.readers.records import Record
from ctm_plugin.errors import DataError
from ctm_plugin.scene.camera_paths import KeyFrames
from ctm_plugin.scene.poses import MAX_COORDINATE, check_rotation, is_field_of_view

EXPECTED = "an object of keys, a list of objects {camera_to_world, fov}, and closed, true or false"


def read_key_frames(path: Path) -> KeyFrames:
    """Read a file of key frames.

    Raises:
        DataError: the file cannot be read, or see :func:`parse_key_frames`.
    """
    return parse_key_frames(read_bytes(path, "a file of key frames"), path)


def parse_key_frames(content: bytes, source: Path) -> KeyFrames:
    """Read ``{"closed": false, "keys": [{"camera_to_world": 3x4, "fov": degrees}, ...]}``.

    Args:
        content: JSON. ``camera_to_world`` has OpenGL axes, ``fov`` is vertical; ``closed`` may be left out.
        source: where it comes from, for messages.

    Raises:
        DataError: it is something else, or a camera is none.
    """
    with told(source, "something that is not JSON", "a file of key frames"):
        values = json.loads(content)
    if not isinstance(values, dict) or not isinstance(values.get("closed", False), bool):
        raise DataError(source, "something else", EXPECTED)
    check_keys(Record(values, source), {"keys", "closed"})
    poses, fovs = [], []
    for record in Record(values, source).records("keys", EXPECTED):
        check_keys(record, {"camera_to_world", "fov"})
        pose = record.matrix("camera_to_world", 3, 4, MAX_COORDINATE)
        check_rotation(pose[:, :3], source, record.place("camera_to_world"))
        poses.append(pose)
        fovs.append(
            math.radians(record.number("fov", lambda fov: is_field_of_view(math.radians(fov)), "degrees in (0, 180)"))
        )
    return KeyFrames(np.stack(poses), np.array(fovs), values.get("closed", False))


def check_keys(record: Record, known: set[str]) -> None:
    """Refuse what nothing reads.

    Raises:
        DataError: there is another key.
    """
    if unknown := sorted(record.values.keys() - known):
        raise DataError(record.source, f"an unknown key {record.place(unknown[0])!r}", EXPECTED)
