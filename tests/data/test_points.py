"""The points that reconstructions have: where they are in the scene's world, and which training views see them."""

import json
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from ctm_scenes.trajectory import hemisphere
from layouts import (
    COUNT,
    HOUSE,
    NAMES,
    POINTS,
    llff_layout,
    room_poses,
    transforms_layout,
    write_camera,
    write_images,
    write_ply,
    write_points,
)
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.data.colmap import ColmapConfig
from ctm_plugin.data.llff import LLFFConfig
from ctm_plugin.data.points import paired
from ctm_plugin.data.readers.colmap_model import Cursor
from ctm_plugin.data.transforms import TransformsConfig
from ctm_plugin.rays.cameras import distort
from ctm_plugin.runs.provenance import fingerprint
from ctm_plugin.scene.views import Points, Scene

SEEN = [[10, 11, 99], [10, 12], [12, 10, 10], [10, 13], [10], [10], [10], [10], [10, 11]]
"""Of nine pictures: 10 in all, 11 in the two for testing, 12 in the first two for training, 13 in one, 99 is none."""


def poses() -> np.ndarray:
    return hemisphere(COUNT, 4.0, seed=3)


def write_model(folder: Path, poses: np.ndarray, points: np.ndarray, seen: list[list[int]], names: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_camera(folder / "cameras.bin", 1, (30.0, 30.0, 12.0, 8.0))
    write_images(folder / "images.bin", poses, seen, names)
    write_points(folder / "points3D.bin", points)


@pytest.fixture
def yard(yard) -> Path:
    write_images(yard / "sparse/0/images.bin", poses(), SEEN, NAMES)
    return yard


@pytest.fixture
def house(tmp_path) -> Path:
    """With near and far; COLMAP's model beside it lies in another world, in a folder of its own."""
    root = transforms_layout(tmp_path / "house", poses(), **HOUSE)
    turn, away = Rotation.random(random_state=1).as_matrix(), poses()
    away[:, :3] = turn @ away[:, :3]
    away[:, :3, 3] = 7 * away[:, :3, 3] + [1, -2, 30]
    write_model(root / "sparse/0", away, 7 * POINTS @ turn.T + [1, -2, 30], SEEN, [f"low/{name}" for name in NAMES])
    return root


def quietly(config) -> Scene:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return config.load()


def pairs(points: Points) -> set[tuple[int, int]]:
    """Point and view."""
    found = list(zip(points.point.tolist(), points.view.tolist(), strict=True))
    assert len(set(found)) == len(found)
    return set(found)


def is_cloud(points: Points, expected: np.ndarray) -> bool:
    return np.allclose(points.positions.numpy(), expected, atol=1e-5)


def test_training_pictures_that_see_points(yard):
    """A point that one of them sees alone, or those for testing, is left out."""
    points = ColmapConfig(root=yard).load().points
    assert is_cloud(points, POINTS[[0, 2]])
    assert pairs(points) == {(0, view) for view in range(7)} | {(1, 0), (1, 1)}
    points = ColmapConfig(root=yard, skip=3, near=1, far=7).load().points
    assert is_cloud(points, POINTS[:1])
    assert pairs(points) == {(0, 0), (0, 1), (0, 2)}


def test_views_count_without_missing_pictures(yard):
    (yard / "images/f_01.png").unlink()
    with pytest.warns(UserWarning, match="1 of 9 pictures are missing"):
        scene = ColmapConfig(root=yard, test_every=4).load()
    assert scene.train.names == ("f_02", "f_03", "f_04", "f_06", "f_07", "f_08")
    write_images(yard / "sparse/0/images.bin", poses(), [[10]] * 4 + [[11]] * 5, NAMES)
    with pytest.warns(UserWarning, match="1 of 9 pictures are missing"):
        points = ColmapConfig(root=yard, test_every=4).load().points
    assert is_cloud(points, POINTS[:2])
    assert pairs(points) == {(0, 0), (0, 1), (1, 2), (1, 3), (1, 4), (1, 5)}


@pytest.mark.parametrize(("seen", "count"), [([[], [10], [11], *[[]] * 6], 2), ([[]] * COUNT, 4)])
def test_points_that_none_sees_twice(yard, seen, count):
    """Where there are no others those count that one sees; where none sees any, all of them."""
    write_images(yard / "sparse/0/images.bin", poses(), seen, NAMES)
    points = quietly(ColmapConfig(root=yard, near=1, far=7)).points
    assert is_cloud(points, POINTS[:count])
    assert pairs(points) == ({(0, 0), (1, 1)} if count == 2 else set())


def test_points_are_no_part_of_the_fingerprint(yard):
    scene = ColmapConfig(root=yard).load()
    assert fingerprint(scene) == fingerprint(replace(scene, points=None))


@pytest.mark.parametrize("spoil", [lambda path: path.unlink(), lambda path: path.write_bytes(path.read_bytes()[:70])])
def test_damaged_points_break_no_load_that_does_without(yard, house, spoil):
    for root, config in ((yard, ColmapConfig(root=yard, near=1, far=7)), (house, TransformsConfig(root=house))):
        spoil(root / "sparse/0/points3D.bin")
        assert quietly(config).points is None


def test_a_model_beside_in_another_world(house):
    points = quietly(TransformsConfig(root=house)).points
    assert is_cloud(points, POINTS[[0, 2]])
    assert pairs(points) == {(0, view) for view in range(7)} | {(1, 0), (1, 1)}
    points = quietly(TransformsConfig(root=house, skip=3)).points
    assert pairs(points) == {(0, 0), (0, 1), (0, 2)}


def test_a_model_beside_without_some_pictures(house):
    write_model(house / "sparse/0", poses()[2:], POINTS, SEEN[2:], NAMES[2:])
    points = quietly(TransformsConfig(root=house)).points
    assert is_cloud(points, POINTS[:1])
    assert pairs(points) == {(0, view) for view in range(1, 7)}


def test_pictures_are_paired_by_as_much_of_their_paths_as_tells_them_apart():
    ours = ["images/cam0/0001.png", "images/cam1/0001.png", "images/0002.png", "images/e.x/0003.a.png", "a.png"]
    theirs = ["cam1/0001.JPG", "cam0\\0001.jpg", "low/0002.jpg", "0003.A.jpg", "b/a.png", "c/a.png"]
    assert paired(theirs, ours) == dict(zip(theirs[:4], [ours[1], ours[0], ours[2], ours[3]], strict=True))


def test_a_ply_where_the_model_is_another(house):
    content = json.loads((house / "transforms.json").read_text())
    (house / "transforms.json").write_text(json.dumps({**content, "ply_file_path": "sparse_pc.ply"}))
    write_ply(house / "sparse_pc.ply", 2 * POINTS, "ascii")
    assert is_cloud(quietly(TransformsConfig(root=house)).points, POINTS[[0, 2]])
    write_model(house / "sparse/0", hemisphere(COUNT, 4.0, seed=4), POINTS, SEEN, NAMES)
    points = quietly(TransformsConfig(root=house)).points
    assert is_cloud(points, 2 * POINTS)
    assert len(points.point) == len(points.view) == 0
    for text in ("ply\n", None):
        (house / "sparse_pc.ply").write_text(text) if text else (house / "sparse_pc.ply").unlink()
        assert quietly(TransformsConfig(root=house)).points is None


@pytest.mark.parametrize("renamed", [False, True])
def test_a_model_beside_llffs_poses(tmp_path, renamed):
    """Shrunk pictures may be named anew, in the same order."""
    root = llff_layout(tmp_path / "room", (24, 16))
    assert LLFFConfig(root=root).load().points is None
    names = [f"view_{index:03d}.png" for index in range(11)]
    if renamed:
        (root / "images_2").mkdir()
        for index, name in enumerate(names):
            (root / "images" / name).rename(root / f"images_2/image{index:03d}.png")
            shutil.copy(root / f"images_2/image{index:03d}.png", root / f"images/IMG_{30 + index}.png")
            names[index] = f"IMG_{30 + index}.JPG"
        for path in (root / "depth").iterdir():
            path.rename(path.with_name(path.name.replace("view_", "image")))
    write_model(root / "sparse/0", room_poses(), POINTS, [[10], [10], [10, 11], *[[11]] * 8], names)
    scene = quietly(LLFFConfig(root=root, factor=2 if renamed else None, downscale=1))
    assert pairs(scene.points) == {(0, 0), (0, 1)} | {(1, view) for view in (1, 2, 3, 4, 5, 6, 7, 8)}
    assert is_cloud(scene.points, scene.world.moved(POINTS[:2]))


def test_others_have_none(tiny):
    assert BlenderConfig(root=tiny).load().points is None


def pixels(scene: Scene) -> torch.Tensor:
    """Where each point is in the training views that see it, ``[T, 2]``: through the lens, column and row."""
    views, points = scene.train, scene.points
    c2w, (fx, fy, cx, cy) = views.c2w[points.view].double(), views.intrinsics[points.view].double().T
    x, y, z = torch.einsum("tji,tj->it", c2w[:, :, :3], points.positions[points.point].double() - c2w[:, :, 3])
    assert (z < 0).all()
    x, y = x / -z, y / z
    if views.distortion is not None:
        x, y = distort(x, y, views.distortion[points.view].double())
    return torch.stack([cx + fx * x, cy + fy * y], dim=1)


def keypoints(path: Path) -> dict[str, np.ndarray]:
    """Where COLMAP found points, in each picture by its name, ``[P, 2]``."""
    cursor, found = Cursor(path), {}
    kind = np.dtype([("place", "<f8", 2), ("point", "<i8")])
    for _ in range(cursor.count(73, "pictures")):
        cursor.take("i7di", "picture")
        name = Path(cursor.text("name")).stem
        rows = np.frombuffer(cursor.data, kind, cursor.count(24, "points"), cursor.at)
        cursor.at += rows.nbytes
        found[name] = rows["place"][rows["point"] >= 0]
    return found


def test_lom(ctm_data):
    """Points project to where COLMAP found them in the pictures."""
    root = ctm_data / "lom" / "buu"
    scene = TransformsConfig(root=root, dark="low", lit="high", near=1, far=9).load()
    assert len(scene.points.positions) > 1000
    found = pixels(scene).numpy()
    assert ((found > 0) & (found < [scene.train.width, scene.train.height])).all(1).mean() > 0.95
    places = keypoints(root / "sparse/0/images.bin")
    for view, name in enumerate(scene.train.names):
        mine = found[scene.points.view.numpy() == view]
        assert len(mine) > 100
        assert np.median(KDTree(places[Path(name).stem]).query(mine)[0]) < 1.0
