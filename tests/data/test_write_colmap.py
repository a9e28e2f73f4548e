"""COLMAP's model as we write it, read by our reader and by COLMAP itself."""

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from ctm_scenes.trajectory import hemisphere

from ctm_plugin.data.readers.colmap_model import Taken, read_cameras, read_images, read_points
from ctm_plugin.data.readers.lens import Intrinsics
from ctm_plugin.data.write_colmap import write_model

CAMERAS = [
    Intrinsics(24.0, 16.0, 30.0, 29.0, 12.5, 7.5, distortion)
    for distortion in ((0.0,) * 5, (-0.08, 0.01, 0.001, -0.002, 0.0), (-0.08, 0.01, 0.001, -0.002, 0.003))
]
TAKEN = [
    Taken(f"höhe {index}.png", pose[:3], camera, np.array(points, dtype=np.int64))
    for index, (pose, camera, points) in enumerate(
        zip(hemisphere(3, 4.0, seed=1), (2, 1, 3), ([4, 1], [], [1]), strict=True)
    )
]
PLACES = [np.array([[3.5, 4.25], [20.0, 1.0]]), np.empty((0, 2)), np.array([[11.0, 12.0]])]
POSITIONS = np.array([[0.5, 0, 0], [-1, 0.2, 0.1], [0, 1, -0.5], [0, 0, 1e5]])
COLORS = np.arange(12, dtype=np.uint8).reshape(4, 3)
READ = """
import json, sys, pycolmap
found = pycolmap.Reconstruction(sys.argv[1])
print(json.dumps({
    "cameras": {n: (c.model.name, c.width, c.height, list(c.params)) for n, c in found.cameras.items()},
    "images": {i.name: (
        i.camera_id, i.cam_from_world().inverse().matrix().tolist(),
        [(p.point3D_id, *p.xy) for p in i.points2D if p.has_point3D()],
    ) for i in found.images.values()},
    "points": {n: (p.xyz.tolist(), p.color.tolist(), [(e.image_id, e.point2D_idx) for e in p.track.elements])
               for n, p in found.points3D.items()},
}))
"""


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("written") / "sparse/0"
    write_model(folder, CAMERAS, TAKEN, PLACES, POSITIONS, COLORS)
    return folder


def test_our_reader_reads_it(model):
    cameras = read_cameras(model / "cameras.bin")
    assert [camera._replace(where="a camera") for camera in cameras.values()] == CAMERAS
    for found, given in zip(read_images(model / "images.bin", cameras), TAKEN, strict=True):
        assert (found.name, found.camera, found.points.tolist()) == (given.name, given.camera, given.points.tolist())
        np.testing.assert_allclose(found.c2w, given.c2w, atol=1e-12)
    numbers, positions = read_points(model / "points3D.bin")
    assert numbers.tolist() == [1, 2, 3, 4]
    assert (positions == POSITIONS).all()


@pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is not installed: pip install -e '.[colmap]'")
def test_colmap_reads_it(model):
    """In a process of its own, so that no other test meets pycolmap's libraries."""
    told = subprocess.run([sys.executable, "-c", READ, model], capture_output=True, text=True, check=True, timeout=60)
    found = json.loads(told.stdout)
    kinds = {number: (camera[0], len(camera[3])) for number, camera in found["cameras"].items()}
    assert kinds == {"1": ("PINHOLE", 4), "2": ("OPENCV", 8), "3": ("FULL_OPENCV", 12)}
    k1, k2, p1, p2, k3 = CAMERAS[2].distortion
    assert found["cameras"]["3"][1:] == [24, 16, [30.0, 29.0, 12.5, 7.5, k1, k2, p1, p2, k3, 0, 0, 0]]
    for each, places in zip(TAKEN, PLACES, strict=True):
        camera, pose, seen = found["images"][each.name]
        assert camera == each.camera
        np.testing.assert_allclose(np.array(pose) * [1, -1, -1, 1], each.c2w, atol=1e-12)
        assert seen == [[int(point), *at] for point, at in zip(each.points, places.tolist(), strict=True)]
    points = found["points"]
    assert [points[number][0] for number in "1234"] == POSITIONS.tolist()
    assert [points[number][1] for number in "1234"] == COLORS.tolist()
    assert [points[number][2] for number in "1234"] == [[[1, 1], [3, 0]], [], [], [[1, 0]]]
