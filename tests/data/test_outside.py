"""No file of a data set leads outside its folder by a name, links do; none unpickles."""

import json
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from ctm_scenes.trajectory import hemisphere
from layouts import MAKE, write_images
from strangers import Payload

from ctm_plugin.errors import DataError
from ctm_plugin.settings.build import build
from ctm_plugin.settings.registry import DATASETS


def load(name: str, root: Path, **settings: object):
    settings |= {} if name == "blender" else {"test_every": 2}
    return build(DATASETS.get(name), {"root": str(root), **settings}, "dataset").load()


def refused(name: str, root: Path) -> str:
    with pytest.raises(DataError, match="which leads outside") as error:
        load(name, root)
    return str(error.value)


READ = [
    ("blender", "transforms_train.json"), ("blender", "transforms_test.json"), ("blender", "train/r_1.png"),
    ("blender", "test/r_1_depth.png"), ("blender", "settings.json"), ("transforms", "transforms.json"),
    ("transforms", "images/f_01.png"), ("transforms", "images"), ("colmap", "sparse/0/cameras.bin"),
    ("colmap", "sparse/0/images.bin"), ("colmap", "sparse/0/points3D.bin"), ("colmap", "sparse"),
    ("colmap", "images/f_01.png"), ("llff", "poses_bounds.npy"), ("llff", "images/view_001.png"), ("llff", "images"),
    ("llff", "depth/view_002.npy"), ("llff", "settings.json"), ("rawnerf", "raw/IMG_001.dng"), ("rawnerf", "raw"),
    ("rawnerf", "raw/IMG_001.json"), ("rawnerf", "poses_bounds.npy"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "file"), READ)
def test_links_are_followed(tmp_path, name, file):
    root = MAKE[name](tmp_path / "set")
    (root / "settings.json").write_text('{"light": 0.5}')
    load(name, root)
    outside = tmp_path / "outside"
    (root / file).rename(outside)
    (root / file).symlink_to(outside)
    load(name, root)


def test_dots_behind_a_link_stay_inside(tmp_path):
    """``images/..`` is the data set's folder, wherever ``images`` leads."""
    root = MAKE["transforms"](tmp_path / "set")
    (tmp_path / "elsewhere").mkdir()
    (root / "images").rename(tmp_path / "elsewhere" / "images")
    (root / "images").symlink_to(tmp_path / "elsewhere" / "images")
    (tmp_path / "elsewhere" / "secret.png").write_bytes((root / "images/f_01.png").read_bytes())
    rename(root, "images/../secret.png", "transforms.json")
    with pytest.warns(UserWarning, match="1 of 5 pictures are missing and left out, such as 'images/../secret.png'"):
        load("transforms", root)


def rename(root: Path, name: str, file: str, key: str = "file_path") -> None:
    content = json.loads((root / file).read_text())
    content["frames"][1][key] = name
    (root / file).write_text(json.dumps(content))


def rename_colmap(root: Path, name: str) -> None:
    names = [f"f_{index:02d}.png" for index in range(4)]
    write_images(root / "sparse/0/images.bin", hemisphere(5, 4.0, seed=3), [[10]] * 5, [*names, name])


OUT = (
    "/etc/passwd", "../../etc/passwd", "..\\..\\etc\\passwd", "C:\\a.png", "\\\\host\\a.png", "c:/a.png",
    "../set2/train/r_0.png", "train/../../set2/train/r_0.png", "{outside}",
)  # fmt: skip
DEPTH = partial(rename, file="transforms_test.json", key="depth_file_path")
RENAMED = [("blender", DEPTH), ("transforms", partial(rename, file="transforms.json"))]


@pytest.mark.parametrize(
    ("layout", "rename", "name"),
    [
        *((*each, name) for each in RENAMED for name in OUT),
        *(("colmap", rename_colmap, name) for name in ("../../etc/passwd", "../../set2/train/r_0.png")),
    ],
)
def test_names_that_lead_out(tmp_path, layout: str, rename: Callable[[Path, str], None], name: str):
    root = MAKE[layout](tmp_path / "set")
    outside = MAKE["blender"](tmp_path / "set2") / "train" / "r_0.png"
    rename(root, name.format(outside=outside))
    assert str(root) in refused(layout, root)


def test_absolute_names_in_colmap_lie_below_images(tmp_path):
    """Not where they say: the picture is missing, as far as the loader knows."""
    root = MAKE["colmap"](tmp_path / "set")
    rename_colmap(root, str(MAKE["blender"](tmp_path / "set2") / "train" / "r_0.png"))
    with pytest.warns(UserWarning, match="1 of 5 pictures are missing"):
        scene = load("colmap", root)
    assert len(scene.train) + len(scene.test) == 4


@pytest.mark.parametrize(("name", "file"), [("llff", "poses_bounds.npy"), ("llff", "depth/view_002.npy")])
def test_code_in_arrays_does_not_run(tmp_path, name, file):
    root = MAKE[name](tmp_path / "set")
    array = np.load(root / file).astype(object)
    array.flat[0] = Payload(tmp_path / "touched")
    np.save(root / file, array, allow_pickle=True)
    with pytest.raises(DataError, match=f"{file}: found no array that can be read"):
        load(name, root)
    assert not (tmp_path / "touched").exists()
    np.load(root / file, allow_pickle=True)
    assert (tmp_path / "touched").exists()  # it would have


@pytest.mark.parametrize(("name", "file"), [each for each in READ if Path(each[1]).suffix])
def test_pipes_are_not_waited_for(tmp_path, name, file):
    root = MAKE[name](tmp_path / "set")
    (root / file).unlink(missing_ok=True)
    os.mkfifo(root / file)
    if name in ("transforms", "colmap") and file.startswith("images"):  # as if it were not there
        with pytest.warns(UserWarning, match="1 of 5 pictures are missing"):
            load(name, root)
        return
    with pytest.raises(DataError) as error:
        load(name, root)
    assert str(root) in str(error.value)
