"""The geometry that the configuration asks for: NDC's world, bounds, and what cannot be had."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from ctm_scenes.trajectory import forward_facing

from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.data.embedded import StillLifeConfig
from ctm_plugin.data.llff import LLFFConfig
from ctm_plugin.data.load import to_ndc_frame
from ctm_plugin.data.near_far import ray_bounds
from ctm_plugin.errors import ConfigError
from ctm_plugin.scene.views import Points, Scene, Views


def grid(geometry: str, near: float = 2.0, target: tuple = (2.0, 1.0, 1.0)) -> Scene:
    poses = torch.from_numpy(forward_facing(6, (2.0, -3.0, 1.0), np.array(target), (1.0, 0.8), seed=2)[:, :3]).float()
    parts = [
        Views(
            torch.zeros(len(c2w), 6, 8, 3, dtype=torch.uint8),
            c2w,
            torch.tensor([[8.0, 8.0, 4.0, 3.0]]).repeat(len(c2w), 1),
            tuple(map(str, range(len(c2w)))),
            depth=torch.full((len(c2w), 6, 8), 5.0),
        )
        for c2w in (poses[:4], poses[4:])
    ]
    return Scene("grid", *parts, near=near, far=8.0, geometry=geometry, background="black")


def test_forward_is_a_similarity_with_near_at_its_place():
    old, new = grid("bounded"), to_ndc_frame(grid("forward"), Path("here"))
    scale = 1 / (0.75 * old.near)
    assert (new.near, new.far) == (1.0, pytest.approx(8.0 * scale))
    torch.testing.assert_close(new.test.depth, old.test.depth * scale)
    before, after = (torch.cat([s.train.c2w, s.test.c2w]).double() for s in (old, new))
    between = [torch.cdist(c2w[:, :, 3], c2w[:, :, 3]) for c2w in (before, after)]
    torch.testing.assert_close(between[1], scale * between[0], atol=1e-5, rtol=0)
    turns = [c2w[0, :, :3].T @ c2w[:, :, :3] for c2w in (before, after)]
    torch.testing.assert_close(*turns, atol=1e-6, rtol=0)
    torch.testing.assert_close(after[:, :, 3].mean(0), torch.zeros(3).double(), atol=1e-6, rtol=0)
    assert (after[:, 2, 2] > 0.9).all()


def test_points_move_with_the_cameras():
    """Each camera sees them in the directions in which it saw them, at distances that grow alike."""
    positions = torch.tensor([[2.0, 1.0, 1.0], [2.5, 2.0, 0.5], [1.0, 4.0, 2.0]])
    points = Points(positions, point=torch.tensor([0, 2]), view=torch.tensor([1, 3]))
    old = replace(grid("forward"), points=points)
    new = to_ndc_frame(old, Path("here"))
    seen = [
        torch.einsum("nji,npj->npi", c2w[:, :, :3], found[None] - c2w[:, None, :, 3])
        for c2w, found in ((s.train.c2w.double(), s.points.positions.double()) for s in (old, new))
    ]
    torch.testing.assert_close(seen[1], seen[0] / (0.75 * old.near), atol=1e-5, rtol=0)
    assert new.points.point is points.point
    assert new.points.view is points.view
    assert to_ndc_frame(grid("forward"), Path("here")).points is None


@pytest.mark.parametrize("geometry", ["bounded", "unbounded"])
def test_others_stay_where_they_are(geometry):
    scene = grid(geometry)
    assert to_ndc_frame(scene, Path("here")) is scene


def test_bounds_out_of_depths():
    views = grid("forward").train
    corner = math.sqrt(1 + 0.5**2 + 0.375**2)
    assert ray_bounds(2.0, 6.0, "forward", views) == (2.0, pytest.approx(6 * corner))
    assert ray_bounds(2.0, 6.0, "unbounded", views) == (1.8, pytest.approx(6 * corner))


def test_cameras_all_round_cannot_face_forward(tiny):
    message = r"dataset\.geometry: found 'forward', expected bounded or unbounded: not all rays of "
    with pytest.raises(ConfigError, match=message + f"{tiny} start in front of near"):
        BlenderConfig(root=tiny, geometry="forward").load()
    with pytest.raises(ConfigError, match=message):
        StillLifeConfig(geometry="forward").load()
    with pytest.raises(ConfigError, match=r"dataset\.near: found 0\.0, expected more than 0 for dataset.geometry=fo"):
        to_ndc_frame(grid("forward", near=0.0), Path("here"))
    scene = grid("forward")
    scene.train.c2w[0, :, 3] -= 3 * scene.train.c2w[0, :, 2]  # behind the others' near plane
    with pytest.raises(ConfigError, match=message):
        to_ndc_frame(scene, Path("here"))


def test_unbounded_llff_keeps_the_files_units(ctm_data):
    rows = np.load(ctm_data / "fern" / "poses_bounds.npy")
    scene = LLFFConfig(root=ctm_data / "fern", downscale=8, geometry="unbounded").load()
    assert scene.geometry == "unbounded"
    torch.testing.assert_close(
        scene.test.c2w[0, :, 3].double(), torch.from_numpy(rows[0, [3, 8, 13]]), rtol=1e-6, atol=0
    )
    assert scene.near == pytest.approx(0.9 * rows[:, 15].min())
    assert rows[:, 16].max() < scene.far < 1.5 * rows[:, 16].max()
