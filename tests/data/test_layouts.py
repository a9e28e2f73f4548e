"""Which layout a folder is of, and that a loader of another one says so."""

import json
from pathlib import Path

import numpy as np
import pytest
from layouts import HOUSE, blender_layout, colmap_layout, llff_layout, rawnerf_layout, transforms_layout

from ctm_plugin.data.planar import PlanarConfig
from ctm_plugin.data.readers.layouts import layouts
from ctm_plugin.errors import DataError
from ctm_plugin.scenes.trajectory import hemisphere
from ctm_plugin.settings.build import build
from ctm_plugin.settings.registry import DATASETS


def lom(root: Path) -> Path:
    """Files of both splits with lenses, and COLMAP's model."""
    colmap_layout(root, hemisphere(5, 4.0, seed=3))
    for split in ("train", "test"):
        frames = [{"file_path": "images/f_00.png", "transform_matrix": np.eye(4).tolist(), "k1": 0.1}]
        (root / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    return root


MAKE = {
    "blender": blender_layout,
    "transforms": lambda root: transforms_layout(root, hemisphere(5, 4.0, seed=3), **HOUSE),
    "colmap": lambda root: colmap_layout(root, hemisphere(5, 4.0, seed=3)),
    "llff": lambda root: llff_layout(root, (24, 16), 5),
    "rawnerf": lambda root: rawnerf_layout(root, np.full((32, 48, 3), 0.1), 5),
}
READERS = {name: {name} for name in MAKE} | {
    "blender": {"blender", "transforms"}, "llff": {"llff", "rawnerf"}, "rawnerf": {"llff", "rawnerf"}
}  # fmt: skip
"""Who else tries to read a folder."""


@pytest.mark.parametrize("name", MAKE)
def test_the_best_fitting_comes_first(tmp_path, name):
    root = MAKE[name](tmp_path / name)
    assert layouts(root)[0] == name
    assert set(layouts(root)) == READERS[name]


def test_several_at_once(tmp_path):
    assert layouts(lom(tmp_path / "lom")) == ["transforms", "blender", "colmap"]
    assert layouts(tmp_path) == []


@pytest.mark.parametrize(("asked", "there"), [(a, b) for a in MAKE for b in MAKE if a not in READERS[b]])
def test_another_layout_is_named(tmp_path, asked, there):
    root = MAKE[there](tmp_path / "set")
    found = rf"set: found files of another layout, expected a folder with .*; dataset={there} reads what is there"
    with pytest.raises(DataError, match=found):
        build(DATASETS.get(asked), {"root": str(root)}, "dataset").load()


def test_blender_names_what_it_would_ignore(tmp_path):
    root = lom(tmp_path / "lom")
    with pytest.raises(
        DataError, match=r"found frames\[0\]\.k1 = 0\.1, expected camera_angle_x alone .* dataset=transforms"
    ):
        build(DATASETS.get("blender"), {"root": str(root)}, "dataset").load()


@pytest.mark.parametrize("text", ["{", "[]", '{"frames": 3}', '{"frames": [3]}'])
def test_a_damaged_file_is_recognised(tmp_path, text):
    root = blender_layout(tmp_path / "set")
    (root / "transforms_train.json").write_text(text)
    assert layouts(root) == ["blender", "transforms"]


def test_dng(tmp_path):
    root = rawnerf_layout(tmp_path / "set", np.full((32, 48, 3), 0.1), 5)
    with pytest.raises(DataError, match=r"IMG_001\.dng: found a raw picture, expected .*dataset=rawnerf"):
        PlanarConfig(image=root / "raw/IMG_001.dng").load()
    (root / "raw").rename(root / "images")
    with pytest.raises(DataError, match=r"images: found no pictures, expected files ending in .*by dataset=rawnerf"):
        build(DATASETS.get("llff"), {"root": str(root)}, "dataset").load()
