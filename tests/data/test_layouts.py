"""Which layout a folder is of, and that a loader of another one says so."""

import json
import shlex
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


@pytest.mark.parametrize(
    ("file", "text", "hint"),
    [
        ("keyframes/cameras/1.json", "x", "Polycam's .*: ns-process-data polycam --data {root} --output-dir capture"),
        ("EXR_RGBD/metadata.json", "x", "Record3D's .*: ns-process-data record3d --data {root} --output-dir capture"),
        ("list.csv", "#name,x,y,alt,heading", ".*realitycapture --data {root}/images --csv {root}/list.csv --output"),
        ("c.xml", "<document>\n  <chunk>", "Metashape's .*metashape --data {root}/images --xml {root}/c.xml --output"),
        ("opensfm/reconstruction.json", "[]", "OpenDroneMap's .*: ns-process-data odm --data {root} --output-dir"),
        ("exif.csv", "SourceFile,ISO", "ctm cameras {root} pictures=rgb finds those of the photographs in rgb, for"),
    ],
)
def test_what_other_programs_leave(tmp_path, file, text, hint):
    """Whose it is, what turns it into what is read, and what finds the cameras of the photographs beside it."""
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).write_text(text)
    (tmp_path / "rgb").mkdir()
    (tmp_path / "rgb/a.png").touch()
    found = rf"found no cameras, .*; {hint.format(root=tmp_path)}.*ctm cameras {tmp_path} pictures=rgb finds"
    if "pictures=rgb" in hint:
        found = rf"found no cameras, expected a folder with sparse/0 and images; {hint.format(root=tmp_path)}"
    with pytest.raises(DataError, match=found):
        build(DATASETS.get("colmap"), {"root": str(tmp_path)}, "dataset").load()


def test_a_command_with_a_folder_that_has_spaces_can_be_pasted(tmp_path):
    root = tmp_path / "my capture"
    (root / "rgb").mkdir(parents=True)
    (root / "my list.csv").write_text("#name,x,y,alt,heading")
    with pytest.raises(DataError) as caught:
        build(DATASETS.get("colmap"), {"root": str(root)}, "dataset").load()
    command = str(caught.value).partition("are not read: ")[2].partition(", of nerfstudio's")[0]
    data = ["--data", f"{root}/images", "--csv", f"{root}/my list.csv"]
    assert shlex.split(command)[:-2] == ["ns-process-data", "realitycapture", *data]


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
    with pytest.raises(DataError, match=r"images: found no pictures, expected files ending in .*by dataset=rawnerf"):
        build(DATASETS.get("llff"), {"root": str(root)}, "dataset").load()
