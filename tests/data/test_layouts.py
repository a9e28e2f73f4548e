"""Which layout a folder is of, and that a loader of another one says so."""

import json
from pathlib import Path

import numpy as np
import pytest
from ctm_scenes.trajectory import hemisphere
from layouts import HOUSE, MAKE, blender_layout, colmap_layout, rawnerf_layout, transforms_layout

from ctm_plugin.data.planar import PlanarConfig
from ctm_plugin.data.readers.layouts import layouts
from ctm_plugin.errors import DataError
from ctm_plugin.settings.build import build
from ctm_plugin.settings.registry import DATASETS


def lom(root: Path) -> Path:
    """Files of both splits with lenses, and COLMAP's model."""
    colmap_layout(root, hemisphere(5, 4.0, seed=3))
    for split in ("train", "test"):
        frames = [{"file_path": "images/f_00.png", "transform_matrix": np.eye(4).tolist(), "k1": 0.1}]
        (root / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    return root


READERS = {name: {name} for name in MAKE} | {
    "blender": {"blender", "transforms"}, "llff": {"llff", "rawnerf"}
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


@pytest.mark.parametrize("there", MAKE)
def test_a_folder_in_a_pictures_place(tmp_path, there):
    root = MAKE[there](tmp_path / "set")
    with pytest.raises(DataError, match=f"found a folder, .*; dataset={there} dataset.root={root} reads it"):
        PlanarConfig(image=root).load()


def test_photographs_without_cameras(tmp_path):
    """The command that finds them can be pasted."""
    root = tmp_path / "my capture"
    (root / "rgb").mkdir(parents=True)
    (root / "rgb/a.png").touch()
    hint = f"ctm cameras '{root}' pictures=rgb finds those of the photographs in rgb"
    with pytest.raises(DataError, match=f"found no cameras, expected a folder with sparse/0 and images; {hint}"):
        build(DATASETS.get("colmap"), {"root": str(root)}, "dataset").load()


@pytest.mark.parametrize(
    ("name", "meant"),
    [("transform.json", "transforms"), ("Transforms.json", "transforms"), ("transform_train.json", "transforms_train")],
)
def test_a_name_that_is_nearly_right(tmp_path, name, meant):
    transforms_layout(tmp_path / "set", hemisphere(5, 4.0, seed=3), **HOUSE)
    (tmp_path / "set/transforms.json").rename(tmp_path / "set" / name)
    with pytest.raises(DataError, match=rf"did you mean {meant}\.json, .* {name} lies there"):
        build(DATASETS.get("transforms"), {"root": str(tmp_path / "set")}, "dataset").load()


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
    with pytest.raises(DataError, match=r"images: found no pictures, expected files ending in .*dataset=rawnerf"):
        build(DATASETS.get("llff"), {"root": str(root)}, "dataset").load()
