"""What our own renderer wrote into a data set: the light it was made with, and the unit of its depth."""

from __future__ import annotations

from pathlib import Path

from ctm_plugin.data.readers.folders import inside
from ctm_plugin.data.readers.records import read_record
from ctm_plugin.scene.poses import MAX_COORDINATE

SETTINGS = "settings.json"


def read_light(root: Path) -> float:
    """The light that a rendering of ours was made with, relative to normal; 1 for data sets from elsewhere."""
    return _setting(root, "light")


def read_depth_scale(root: Path) -> float:
    """Scene units in one step of the depth pictures; 1 where nothing says otherwise."""
    return _setting(root, "depth_scale")


def _setting(root: Path, key: str) -> float:
    path = inside(root, SETTINGS)
    record = read_record(path) if path.exists() else {}
    return record.number(key, lambda v: 0 < v <= MAX_COORDINATE, "a number > 0") if key in record else 1.0
