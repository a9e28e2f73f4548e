"""What our own renderer wrote into a data set: the light it was made with, and the unit of its depth."""

from __future__ import annotations

from pathlib import Path

from ctm_plugin.data.readers.folders import inside
from ctm_plugin.data.readers.records import read_record
from ctm_plugin.scene.poses import MAX_COORDINATE

SETTINGS = "settings.json"


def read_light(root: Path) -> float:
    """The light that a rendering of ours was made with, relative to normal; 1 for data sets from elsewhere."""
    path = inside(root, SETTINGS)
    if not path.exists():
        return 1.0
    settings = read_record(path)
    return settings.number("light", lambda v: 0 < v <= MAX_COORDINATE, "a number > 0") if "light" in settings else 1.0


def read_depth_scale(root: Path) -> float:
    """Scene units in one step of the depth pictures; 1 where nothing says otherwise."""
    path = inside(root, SETTINGS)
    if not path.exists():
        return 1.0
    settings = read_record(path)
    if "depth_scale" not in settings:
        return 1.0
    return settings.number("depth_scale", lambda v: 0 < v <= MAX_COORDINATE, "scene units a step, a number > 0")
