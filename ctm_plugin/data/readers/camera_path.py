"""Files of key frames, as the viewer saves them and ``render path=FILE`` films them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ctm_plugin.color.settings import CONTRASTS, MAX_STOPS, SATURATIONS
from ctm_plugin.data.readers.folders import read_bytes
from ctm_plugin.data.readers.records import parse_record
from ctm_plugin.errors import DataError
from ctm_plugin.scene.camera_paths import LIGHT_KEYS, KeyFrames
from ctm_plugin.scene.poses import MAX_COORDINATE, check_rotation, is_field_of_view

PATH_EXPECTED = (
    "an object of keys, a list of objects {camera_to_world, fov}, and closed, true or false; or of the numbers "
    f"{', '.join(LIGHT_KEYS)} besides"
)
LIGHT_RANGES = dict(zip(LIGHT_KEYS, ((-MAX_STOPS, MAX_STOPS), CONTRASTS, SATURATIONS), strict=True))
"""Least and largest value of each key of the light."""


def read_key_frames(path: Path) -> KeyFrames:
    """Read ``{"closed": false, "keys": [{"camera_to_world": 3x4, "fov": degrees}, ...]}``.

    ``camera_to_world`` has OpenGL axes, ``fov`` is vertical; ``closed`` may be left out. So may the light in which the
    path was made: ``light`` in stops, ``contrast`` and ``saturation``, all three of them or none.
    DataError: anything else.
    """
    whole = parse_record(read_bytes(path, "a file of key frames"), path)
    closed = "closed" in whole and whole.checked("closed", lambda value: isinstance(value, bool), PATH_EXPECTED)
    keys = whole.records("keys", PATH_EXPECTED)
    poses, fovs = [], []
    for item, known in ((whole, {"keys", "closed", *LIGHT_KEYS}), *((key, {"camera_to_world", "fov"}) for key in keys)):
        if unknown := sorted(item.values.keys() - known):
            raise DataError(path, f"an unknown key {item.place(unknown[0])!r}", PATH_EXPECTED)
    for key in keys:
        poses.append(key.matrix("camera_to_world", 3, 4, MAX_COORDINATE))
        check_rotation(poses[-1][:, :3], path, key.place("camera_to_world"))
        fov = key.number("fov", lambda fov: is_field_of_view(math.radians(fov)), "degrees in (0, 180)")
        fovs.append(math.radians(fov))
    lit = None
    if whole.values.keys() & set(LIGHT_KEYS):
        lit = tuple(
            whole.number(
                key, lambda number, low=low, high=high: low <= number <= high, f"a number in [{low:g}, {high:g}]"
            )
            for key, (low, high) in LIGHT_RANGES.items()
        )
    return KeyFrames(np.stack(poses), np.array(fovs), closed, lit)
