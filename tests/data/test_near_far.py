"""Near and far out of points and cameras: they hold what is there, and what a few bad points claim is left out."""

import json
import re
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
from ctm_scenes.trajectory import hemisphere
from hypothesis import given
from hypothesis import strategies as st
from layouts import INTRINSICS, write_images, write_ply
from layouts import transforms_layout as written
from scipy.spatial.transform import Rotation

from ctm_plugin.data.colmap import ColmapConfig
from ctm_plugin.data.near_far import camera_bounds, depth_bounds
from ctm_plugin.data.transforms import TransformsConfig
from ctm_plugin.errors import DataError

COUNT, POINTS = 12, 400


def cloud(seed: int = 0) -> np.ndarray:
    """Points in a ball of radius 1: from cameras at 4 they lie between 3 and 5."""
    points = np.random.default_rng(seed).normal(size=(POINTS, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * np.random.default_rng(seed).random((POINTS, 1))


def write_model(folder: Path, poses: np.ndarray, points: np.ndarray, seen: list[list[int]]) -> None:
    """COLMAP's model of a pinhole camera, with points numbered from 0."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, 16, 12, 20.0, 19.0, 8.5, 5.5))
    write_images(folder / "images.bin", poses, seen, [f"f_{index:02d}.png" for index in range(len(poses))])
    rows = [struct.pack("<Q3d11xQ", number, *point, 0) for number, point in enumerate(points)]
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(points)) + b"".join(rows))


def load(root: Path, **settings):
    """The scene and what was told."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        scene = TransformsConfig(**{"root": root, "geometry": "bounded"} | settings).load()
    return scene, [str(each.message) for each in told]


@pytest.fixture
def house(tmp_path) -> Path:
    return written(tmp_path / "house", hemisphere(COUNT, 4.0, seed=3), **INTRINSICS)


@given(st.integers(0, 1000), st.floats(0.0, 0.004), st.floats(0.0, 0.004))
def test_planted_outliers_are_left_out(seed, near, far):
    rng = np.random.default_rng(seed)
    depths = [rng.uniform(3, 5, 500) for _ in range(8)]
    for each in depths:
        each[: int(500 * near)] = 1e-3
        each[::-1][: int(500 * far)] = 1e4
    found = depth_bounds(depths)
    assert 3 <= found[0] < 3.1
    assert 4.9 < found[1] <= 5


def test_a_close_up_among_many_is_not_cut():
    rng = np.random.default_rng(0)
    depths = [rng.uniform(3, 5, 500) for _ in range(200)]
    depths[7] = rng.uniform(0.5, 1, 500)
    depths[9] = rng.uniform(20, 30, 500)
    near, far = depth_bounds(depths)
    assert near == np.percentile(depths[7], 5)
    assert far == np.percentile(depths[9], 95)


def test_what_is_behind_or_no_number_is_not_seen():
    assert depth_bounds([]) is None
    assert depth_bounds([np.array([-1.0, np.nan, 0.0, 1e9])]) is None
    assert depth_bounds([np.array([-1.0, 2.0, np.nan])]) == (2.0, 2.0)


def test_points_that_two_pictures_see_do_not_count(tmp_path):
    """A hundred are matched wrongly, each in two pictures: at a hundredth of the depth, and far out."""
    poses = hemisphere(COUNT, 4.0, seed=3)
    root = written(tmp_path / "yard", poses)
    axes = poses[:2, :3, 3]
    wrong = np.concatenate([0.99 * axes, -50 * axes]).repeat(25, 0)
    points = np.concatenate([cloud(), wrong])
    seen = [list(range(POINTS)) for _ in range(COUNT)]
    for picture in (0, 1):
        seen[picture] += range(POINTS, len(points))
    write_model(root / "sparse/0", poses, points, seen)
    scene = ColmapConfig(root=root).load()
    assert 0.9 * 3 < scene.near < 0.9 * 3.5
    assert 4.5 < scene.far < 5 * 1.2


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "colmap_sparse/0"])
def test_from_a_model_in_another_world(house, place):
    """instant-ngp moves, turns and scales the world; the bounds are those of its own points, moved alike."""
    turn, scale, shift = Rotation.random(random_state=1).as_matrix(), 7.0, np.array([1.0, -2.0, 30.0])
    poses = hemisphere(COUNT, 4.0, seed=3)
    away = poses.copy()
    away[:, :3, :3], away[:, :3, 3] = turn @ poses[:, :3, :3], scale * poses[:, :3, 3] @ turn.T + shift
    write_model(house / place, away, scale * cloud() @ turn.T + shift, [list(range(POINTS))] * COUNT)
    scene, told = load(house)
    depths = -np.einsum("npc,nc->np", cloud()[None] - poses[:, None, :3, 3], poses[:, :3, 2])
    assert scene.near == pytest.approx(0.9 * depth_bounds(list(depths))[0], rel=1e-4)
    assert depth_bounds(list(depths))[1] < scene.far < 1.2 * depth_bounds(list(depths))[1]
    assert len(told) == 1
    said = rf"transforms\.json: no near and far there; .* are taken from the points of {place}: dataset\.near and dat"
    assert re.search(said, told[0])
    assert load(house, near=1, far=9)[1] == []


@pytest.mark.parametrize("damage", ["others", "few", "cut", "empty"])
def test_a_model_that_is_of_no_use(house, damage):
    poses = hemisphere(COUNT, 4.0, seed=4 if damage == "others" else 3)
    write_model(house / "sparse/0", poses[: 2 if damage == "few" else COUNT], cloud(), [list(range(POINTS))] * COUNT)
    if damage in ("cut", "empty"):
        path = house / "sparse/0/points3D.bin"
        path.write_bytes(path.read_bytes()[: 500 if damage == "cut" else 0])
    scene, told = load(house)
    assert (scene.near, scene.far) == pytest.approx((2.0, 8.0), rel=1e-5)
    why = {
        "others": r"the cameras of sparse/0 are others, .* % of their spread and .* degrees off",
        "few": "sparse/0 has 2 of the pictures",
        "cut": r"sparse/0 is of no use: .*points3D\.bin: found .* at byte \d+",
        "empty": "sparse/0 is of no use",
    }[damage]
    assert len(told) == 1
    assert re.search(rf"from where the cameras stand and look \({why}.*\): dataset\.near", told[0])


def set_ply(root: Path, name: object) -> None:
    content = json.loads((root / "transforms.json").read_text())
    (root / "transforms.json").write_text(json.dumps({**content, "ply_file_path": name}))


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_from_a_ply(house, encoding):
    set_ply(house, "sparse_pc.ply")
    behind = np.array([[0.0, 0.0, -500.0]])  # which no camera has in its picture
    write_ply(house / "sparse_pc.ply", np.concatenate([cloud(), behind]), encoding)
    scene, told = load(house)
    assert 0.9 * 3 < scene.near < 0.9 * 3.5
    assert 4.5 < scene.far < 5 * 1.2
    assert "from the points of sparse_pc.ply" in told[0]


def test_a_ply_that_is_not_there_or_damaged(house):
    set_ply(house, "sparse_pc.ply")
    scene, told = load(house)
    assert scene.far == pytest.approx(8.0)
    assert "(sparse_pc.ply is not there)" in told[0]
    (house / "sparse_pc.ply").write_text("ply\n")
    with pytest.raises(DataError, match=r"sparse_pc\.ply: found another header"):
        load(house)
    set_ply(house, "../points.ply")
    with pytest.raises(DataError, match="which leads outside"):
        load(house)
    set_ply(house, 3)
    with pytest.raises(DataError, match="ply_file_path = 3"):
        load(house)


def test_from_cameras_alone():
    around = hemisphere(COUNT, 4.0, seed=3)[:, :3]
    assert camera_bounds(around, "bounded") == pytest.approx((2.0, 8.0))
    assert camera_bounds(around, "unbounded") == pytest.approx((2.0, 40.0))
    inside_out = around * [-1, 1, -1, 1]
    spread = max(np.linalg.norm(a - b) for a in around[:, :, 3] for b in around[:, :, 3])
    assert camera_bounds(inside_out, "bounded") == pytest.approx((0.1 * spread, 10 * spread))
    assert camera_bounds(np.repeat(around[:1], 4, axis=0), "bounded") is None


@pytest.mark.parametrize("geometry", ["bounded", "unbounded"])
@pytest.mark.parametrize("given", [{}, {"near": 1, "far": 9}])
def test_axes_that_meet_behind_are_told(house, tmp_path, geometry, given):
    said = "the cameras' axes meet behind all cameras: they look outwards, or have OpenCV's axes, of which y and z"
    assert not any(said in each for each in load(house, geometry=geometry, **given)[1])
    poses = hemisphere(COUNT, 4.0, seed=3) @ np.diag([1.0, -1.0, -1.0, 1.0])
    root = written(tmp_path / "opencv", poses, **INTRINSICS)
    assert sum(said in each for each in load(root, geometry=geometry, **given)[1]) == 1


def test_all_cameras_at_one_place(tmp_path):
    poses = hemisphere(5, 4.0, seed=3)
    poses[:, :3, 3] = 0
    root = written(tmp_path / "turning", poses, **INTRINSICS)
    with pytest.raises(DataError, match="found no near and far there, all cameras at one place, expected"):
        load(root)


@pytest.mark.parametrize("scene", ["buu", "chair", "bike"])
def test_lom(ctm_data, scene):
    """Bounds from COLMAP's points, and those from the cameras alone, hold what three pictures or more see of them."""
    root = ctm_data / "lom" / scene
    found, told = load(root, downscale=5, skip=9, dark="low", lit="high")
    assert "from the points of sparse/0" in told[0]
    assert 2 < found.near < 3.1
    assert 5.5 < found.far < 7
    poses = np.concatenate([found.train.c2w.numpy(), found.test.c2w.numpy()]).astype(float)
    alone = camera_bounds(poses, "bounded")
    assert alone[0] < found.near
    assert alone[1] > found.far
