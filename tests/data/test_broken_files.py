"""Data sets with a broken file, at random and by seed: they load, or one error names the file."""

import json
import shutil
import warnings
from pathlib import Path
from random import Random

import numpy as np
import pytest
from ctm_scenes.trajectory import hemisphere
from layouts import HOUSE, blender_layout, colmap_layout, llff_layout, rawnerf_layout, transforms_layout

from ctm_plugin.errors import DataError
from ctm_plugin.settings.build import build
from ctm_plugin.settings.registry import DATASETS

LAYOUTS = {
    "blender": lambda root: blender_layout(root, depth=True),
    "colmap": lambda root: colmap_layout(root, hemisphere(5, 4.0, seed=3)),
    "llff": lambda root: llff_layout(root, (24, 16), 5),
    "rawnerf": lambda root: rawnerf_layout(root, np.full((32, 48, 3), 0.1), 4),
    "transforms": lambda root: transforms_layout(root, hemisphere(6, 4.0, seed=3), **HOUSE),
}
CASES = 12
"""Broken copies of each layout."""
STRANGE = (None, True, -1, 0, 1e300, 10**400, "", "../../etc/passwd", "a\0b", "x" * 10_000, [], {}, [[]], [1, "a"])
"""Values that hardly any key expects."""


def truncated(data: bytes, random: Random) -> bytes:
    return data[: random.randrange(len(data) + 1)]


def flipped(data: bytes, random: Random) -> bytes:
    changed = bytearray(data)
    for _ in range(8):
        changed[random.randrange(len(data))] ^= 1 << random.randrange(8)
    return bytes(changed)


def overwritten(data: bytes, random: Random) -> bytes:
    """Eight bytes, as a count, an offset or a size may be, become the largest number."""
    start = random.randrange(len(data) + 1)
    return data[:start] + b"\xff" * 8 + data[start + 8 :]


def replaced(data: bytes, random: Random) -> bytes:
    """A value anywhere in JSON becomes a strange one."""
    node = content = json.loads(data)
    while True:
        key = random.choice(list(node) if isinstance(node, dict) else range(len(node)))
        if not (isinstance(node[key], dict | list) and node[key] and random.random() < 0.8):
            break
        node = node[key]
    node[key] = random.choice(STRANGE)
    return json.dumps(content).encode()


def broken(root: Path, random: Random) -> str:
    """Breaks one file of a folder, each kind of file as likely, and tells how."""
    files = sorted(path for path in root.rglob("*") if path.is_file())
    ending = random.choice(sorted({path.suffix for path in files}))
    path = random.choice([path for path in files if path.suffix == ending])
    how = random.choice([truncated, flipped, overwritten, *[replaced] * 6 * (ending == ".json")])
    path.write_bytes(how(path.read_bytes(), random))
    return f"{path.name} {how.__name__}"


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_broken_data_set_loads_or_is_refused(layout, tmp_path):
    LAYOUTS[layout](tmp_path / "whole")
    for case in range(CASES):
        root, random = tmp_path / f"copy_{case}", Random(f"{layout}/{case}")
        shutil.copytree(tmp_path / "whole", root)
        how = broken(root, random)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            scene, told = None, ""
            try:
                scene = build(DATASETS.get(layout), {"root": str(root)}, "dataset").load()
            except DataError as error:
                told = str(error)
        if scene is None:
            assert str(root) in told, f"case {case}, {how}"
            continue
        assert 0 <= scene.near < scene.far < float("inf"), f"case {case}, {how}"
        for views in (scene.train, scene.test):
            assert views.c2w.isfinite().all(), f"case {case}, {how}"
            assert views.intrinsics.isfinite().all(), f"case {case}, {how}"
