"""Damaged files of every layout load, or are refused in one line; whatever loads can be trained on."""

import json
import math
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from layouts import MAKE

from ctm_plugin.data.readers.colmap_model import read_cameras, read_images, read_points
from ctm_plugin.errors import CTMError, DataError
from ctm_plugin.scene.kinds import GEOMETRIES
from ctm_plugin.settings.registry import DATASETS

ANY_JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([10**400, -(10**400), 2**63, "..", ".", "/", "~", "\0", "\ud800", "images/f_00.png", "x" * 5000])
    | st.floats()
    | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)
KEYS = ["k3", "k4", "test_filenames", "camera_angle_x", "is_fisheye", "mask_path", "ply_file_path", "fov"]
TRAIN, TEST = "transforms_train.json", "transforms_test.json"
MODEL = ("sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin")
FILES = {"blender": (TRAIN, TEST), "transforms": ("transforms.json",), "llff": ("poses_bounds.npy",), "colmap": MODEL}


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> dict[str, tuple[Path, dict[str, bytes]]]:
    """A data set of each layout, shared by all examples, which write its files anew; and what was in these."""
    found = {}
    for layout in FILES:
        MAKE[layout](root := tmp_path_factory.mktemp("mutated") / layout)
        found[layout] = root, {name: (root / name).read_bytes() for name in FILES[layout]}
    return found


def nodes(value: Any, path: tuple = ()) -> list[tuple]:
    """Paths of all values inside ``value``."""
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path] * bool(path) + [found for key, child in children for found in nodes(child, (*path, key))]


def other_values(content: bytes, data: st.DataObject) -> bytes:
    """JSON of which a few values are others, or are not there, or new."""
    tree = json.loads(content)
    for _ in range(data.draw(st.integers(1, 3))):
        places = [*nodes(tree), *((key,) for key in KEYS)]
        *parents, last = data.draw(st.sampled_from(places))
        owner = tree
        for key in parents:
            owner = owner[key]
        if data.draw(st.booleans()):
            owner[last] = data.draw(ANY_JSON)
        else:
            with suppress(KeyError):
                del owner[last]
    return json.dumps(tree).encode()


def other_bytes(content: bytes, data: st.DataObject) -> bytes:
    changed = bytearray(content)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(changed)))
        changed[at : at + data.draw(st.integers(0, 8))] = data.draw(st.binary(max_size=8))
    return bytes(changed)


@pytest.mark.parametrize(
    ("layout", "mutate"),
    [
        *((layout, other_values) for layout in ("blender", "transforms")),
        *((layout, other_bytes) for layout in FILES),
    ],
)
@settings(max_examples=60)
@given(data=st.data())
def test_mutated_files_load_or_are_refused(folders, layout, mutate, data):
    root, originals = folders[layout]
    name = data.draw(st.sampled_from(FILES[layout]))
    for each, content in originals.items():
        (root / each).write_bytes(mutate(content, data) if each == name else content)
    geometry = data.draw(st.sampled_from(GEOMETRIES if layout == "llff" else ("bounded",)))
    with warnings.catch_warnings(), suppress(CTMError):
        warnings.simplefilter("error", RuntimeWarning)
        warnings.simplefilter("ignore", UserWarning)
        scene = DATASETS.get(layout)(root=root, skip=data.draw(st.integers(1, 3)), geometry=geometry).load()
        assert 0 <= scene.near < scene.far < math.inf
        for views in (scene.train, scene.test):
            assert views.c2w.isfinite().all()
            assert views.intrinsics.isfinite().all()


@pytest.mark.parametrize("name", MODEL)
def test_truncated_models_are_refused(folders, name):
    root, originals = folders["colmap"]
    for each, content in originals.items():
        (root / each).write_bytes(content)
    cameras = read_cameras(root / MODEL[0])
    read = dict(zip(MODEL, (read_cameras, lambda path: read_images(path, cameras), read_points), strict=True))[name]
    for length in range(1, len(originals[name]), 1 + len(originals[name]) // 300):
        (root / name).write_bytes(originals[name][:length])
        with pytest.raises(DataError, match=rf"{Path(name).name}: found .* at byte \d+, expected"):
            read(root / name)
