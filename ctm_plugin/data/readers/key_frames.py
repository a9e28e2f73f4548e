"""Files of key frames, as the viewer saves them and ``render path=FILE`` films them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ctm_plugin.color.settings import CONTRASTS, MOST_STOPS, SATURATIONS
from ctm_plugin.data.readers.folders import read_bytes
from ctm_plugin.data.readers.records import parse_record
from ctm_plugin.errors import DataError
from ctm_plugin.scene.camera_paths import LIT, KeyFrames
from ctm_plugin.scene.poses import MAX_COORDINATE, check_rotation, is_field_of_view

EXPECTED = (
    "an object of keys, a list of objects {camera_to_world, fov}, and closed, true or false; or of the numbers "
    f"{', '.join(LIT)} besides"
)
RANGES = dict(zip(LIT, ((-MOST_STOPS, MOST_STOPS), CONTRASTS, SATURATIONS), strict=True))


def read_key_frames(path: Path) -> KeyFrames:
    """Read ``{"closed": false, "keys": [{"camera_to_world": 3x4, "fov": degrees}, ...]}``.

    ``camera_to_world`` has OpenGL axes, ``fov`` is vertical; ``closed`` may be left out. So may the light that the path
    was seen in: ``light`` in stops, ``contrast`` and ``saturation``, all three of them or none.
    """
    whole = parse_record(read_bytes(path, "a file of key frames"), path)
    closed = "closed" in whole and whole.checked("closed", lambda value: isinstance(value, bool), EXPECTED)
    keys = whole.records("keys", EXPECTED)
    poses, fovs = [], []
    for record, known in ((whole, {"keys", "closed", *LIT}), *((key, {"camera_to_world", "fov"}) for key in keys)):
        if unknown := sorted(record.values.keys() - known):
            raise DataError(path, f"an unknown key {record.place(unknown[0])!r}", EXPECTED)
    for key in keys:
        poses.append(key.matrix("camera_to_world", 3, 4, MAX_COORDINATE))
        check_rotation(poses[-1][:, :3], path, key.place("camera_to_world"))
        fov = key.number("fov", lambda fov: is_field_of_view(math.radians(fov)), "degrees in (0, 180)")
        fovs.append(math.radians(fov))
    lit = None
    if whole.values.keys() & set(LIT):
        lit = tuple(
            whole.number(
                key, lambda number, low=low, high=high: low <= number <= high, f"a number in [{low:g}, {high:g}]"
            )
            for key, (low, high) in RANGES.items()
        )
    return KeyFrames(np.stack(poses), np.array(fovs), closed, lit)
