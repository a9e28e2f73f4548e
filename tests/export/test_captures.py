"""Scenes as folders that other programs train on: points, masks, names, and views that have no picture."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.data.colmap import ColmapConfig
from ctm_plugin.data.llff import LLFFConfig
from ctm_plugin.data.readers.colmap_model import read_points
from ctm_plugin.data.readers.ply import read_ply
from ctm_plugin.export.captures import seen, write_capture
from ctm_plugin.rays.cameras import camera_rays
from ctm_plugin.scene.views import Points, Scene, Views

LENS = (-0.05, 0.01, 0.001, -0.002, 0.003)
SIGHTS = ((0, 3.2, 4.9, 2.0), (1, 20.5, 11.1, 2.5), (2, 0.4, 19.7, 3.0))
"""Training views, places in them and how far away what they see there is."""


def coordinates(views: Views, index: int) -> torch.Tensor:
    """A picture whose colours are each pixel's column and row, and which view it is."""
    row, column = torch.meshgrid(torch.arange(views.height), torch.arange(views.width), indexing="ij")
    return torch.stack([column, row, torch.full_like(row, index)], dim=-1).byte()


@pytest.fixture(scope="module")
def scene(hall) -> Scene:
    """Moved for NDC, through lenses, with a point before each of some pixels, and one that nobody sees."""
    scene = LLFFConfig(root=hall).load()
    train, test = (
        replace(views, distortion=torch.tensor([LENS]).repeat(len(views), 1)) for views in (scene.train, scene.test)
    )
    found = []
    for view, x, y, away in SIGHTS:
        one = slice(view, view + 1)
        rays = camera_rays(
            train.c2w[one], train.intrinsics[one], torch.tensor([x]), torch.tensor([y]), train.distortion[one]
        )
        found.append(rays.origins + away * rays.directions)
    positions = torch.cat([found[0], torch.full((1, 3), 50.0), *found[1:]])
    points = Points(positions, torch.tensor([0, 2, 3, 1]), torch.tensor([0, 1, 2, 0]))
    return replace(scene, train=train, test=test, points=points)


def test_points_are_where_pictures_see_them(scene):
    sights = [seen(scene.points, scene.train, index, coordinates(scene.train, index)) for index in range(3)]
    for (view, x, y, _), row, sight in zip(SIGHTS, (0, 2, 3), sights, strict=True):
        assert sight.rows.tolist() == [row]  # not the one that lies outside of the picture
        np.testing.assert_allclose(sight.places, [[x, y]], atol=1e-4)
        assert sight.colors.tolist() == [[int(x), int(y), view]]


def test_points_and_cameras_in_the_files_world(scene, hall, tmp_path):
    write_capture(tmp_path, scene, coordinates)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    wanted = LLFFConfig(root=hall, geometry="bounded").load()
    back = ColmapConfig(root=tmp_path, geometry="bounded").load()
    poses = {Path(frame["file_path"]).stem: torch.tensor(frame["transform_matrix"])[:3] for frame in frames}
    names = wanted.train.names + wanted.test.names
    for given, found in zip(torch.cat([wanted.train.c2w, wanted.test.c2w]), names, strict=True):
        torch.testing.assert_close(poses[found], given, atol=1e-5, rtol=1e-5)
    # LLFF's split is COLMAP's: every eighth by name.
    assert (back.train.names, back.test.names) == (wanted.train.names, wanted.test.names)
    torch.testing.assert_close(
        back.train.c2w, torch.stack([poses[name] for name in back.train.names]), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(back.train.distortion, scene.train.distortion)
    assert (tmp_path / "sparse/0/test.txt").read_text() == "".join(f"{name}.png\n" for name in wanted.test.names)
    _, positions = read_points(tmp_path / "sparse/0/points3D.bin")
    assert len(positions) == len(SIGHTS)
    np.testing.assert_allclose(read_ply(tmp_path / "sparse_pc.ply"), positions, rtol=1e-6)
    eyes = np.stack([wanted.train.c2w[view, :, 3].numpy() for view, *_ in SIGHTS])
    away = np.linalg.norm(positions - eyes, axis=1) * scene.world.scale
    np.testing.assert_allclose(away, [each[3] for each in SIGHTS], rtol=1e-4)


def test_what_nerfstudio_asks_for(ball, tmp_path):
    """By its parser's rules: all masks or none, all lists of splits, sizes and intrinsics, points by name."""
    scene = BlenderConfig(root=ball).load()
    mask = torch.ones(scene.train.images.shape[:3], dtype=torch.bool)
    mask[:, :, :4] = False
    given = replace(scene, train=replace(scene.train, mask=mask))
    write_capture(tmp_path, given, coordinates)
    content = json.loads((tmp_path / "transforms.json").read_text())
    files = [frame["file_path"] for frame in content["frames"]]
    assert sorted(files) == sorted(str(path.relative_to(tmp_path)) for path in (tmp_path / "images").iterdir())
    assert sorted(content["train_filenames"] + content["test_filenames"]) == sorted(files)
    assert content["val_filenames"] == content["test_filenames"] == ["images/test_r_0.png", "images/test_r_1.png"]
    assert {"w", "h", "camera_model"} <= content.keys()
    assert "applied_transform" not in content
    assert "ply_file_path" not in content
    for frame in content["frames"]:
        assert {"fl_x", "fl_y", "cx", "cy", "mask_path"} <= frame.keys()
        assert (tmp_path / frame["mask_path"]).is_file()
    assert not (tmp_path / "sparse_pc.ply").exists()
    numbers, _ = read_points(tmp_path / "sparse/0/points3D.bin")
    assert len(numbers) == 0


@pytest.mark.parametrize("absent", [True, False])
def test_views_without_a_picture(ball, tmp_path, absent):
    scene = BlenderConfig(root=ball).load()

    def one_is_missing(views: Views, index: int) -> torch.Tensor | None:
        return None if views is scene.test and index == 0 else coordinates(views, index)

    write_capture(tmp_path, scene, one_is_missing, absent=absent)
    content = json.loads((tmp_path / "transforms.json").read_text())
    listed = ["images/test_r_0.png"] * absent + ["images/test_r_1.png"]
    assert content["test_filenames"] == listed
    assert len(content["frames"]) == 9 + absent
    assert not (tmp_path / "images/test_r_0.png").exists()
