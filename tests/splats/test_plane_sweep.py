"""Plane sweep: places on a textured wall, and none where pictures are flat."""

import dataclasses

import pytest
import torch
import torch.nn.functional as F
from gaussian_scenes import views_of
from torch import Tensor

from ctm_plugin.scene.views import Scene
from ctm_plugin.splats.plane_sweep import swept_places

HIGH, WIDE, FOCAL, DEPTH = 60, 80, 80.0, 5.0


def wall() -> Scene:
    """Three cameras side by side that look at a wall of smooth random colours, 5 away."""
    texture = torch.rand(1, 3, 40, 80, generator=torch.Generator().manual_seed(0))
    c2w = torch.eye(3, 4).repeat(3, 1, 1)
    c2w[:, 0, 3] = torch.tensor([-0.5, 0.0, 0.5])
    views = views_of(c2w, (FOCAL, FOCAL, WIDE / 2, HIGH / 2), WIDE, HIGH, None)
    images = torch.stack([seen(texture, float(x)) for x in c2w[:, 0, 3]])
    views = dataclasses.replace(views, images=images)
    return Scene("wall", views, views, near=2.0, far=20.0, geometry="unbounded", background="black")


def seen(texture: Tensor, right: float) -> Tensor:
    """The wall, 8 wide and 6 high, from a camera at x = ``right``, ``[H, W, 3]``."""
    x = (torch.arange(WIDE) + 0.5 - WIDE / 2) / FOCAL * DEPTH + right
    y = (torch.arange(HIGH) + 0.5 - HIGH / 2) / FOCAL * DEPTH
    at = torch.stack(torch.broadcast_tensors(x / 4, y[:, None] / 3), -1)[None]
    return F.grid_sample(texture, at, mode="bicubic", align_corners=False)[0].permute(1, 2, 0).clamp(0, 1)


@pytest.mark.parametrize("light", [1.0, 0.05])
def test_places_lie_on_the_wall_in_any_light(light):
    scene = wall()
    views = dataclasses.replace(scene.train, images=light * scene.train.images)
    places, colors = swept_places(dataclasses.replace(scene, train=views), 0)
    assert len(places) > 10
    assert (places[:, 2] + DEPTH).abs().median() < 0.1
    assert colors.shape == places.shape
    assert 0 < colors.max() <= light


def test_flat_pictures_give_no_places():
    scene = wall()
    views = dataclasses.replace(scene.train, images=torch.full_like(scene.train.images, 0.5))
    assert swept_places(dataclasses.replace(scene, train=views), 0)[0].shape == (0, 3)


def test_masked_patches_are_left_out():
    scene = wall()
    mask = torch.ones(scene.train.images.shape[:3], dtype=torch.bool)
    mask[:, :, : WIDE // 2] = False
    places, _ = swept_places(dataclasses.replace(scene, train=dataclasses.replace(scene.train, mask=mask)), 0)
    assert len(places)
    assert (places[:, 0] > -0.6).all()
