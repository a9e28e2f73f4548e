"""Normalised device coordinates: straight lines, a camera worked out by hand."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.errors import DataError
from ctm_plugin.rays.cameras import Rays, camera_rays
from ctm_plugin.rays.ndc import NDC
from ctm_plugin.scene.frustum import ndc_of
from ctm_plugin.scene.views import Scene, Views

SEED = st.integers(0, 10**6)
SOME = NDC(scale_x=1.5, scale_y=2.0, near=0.8)


def looking_forward(seed: int, count: int = 50) -> Rays:
    random = torch.Generator().manual_seed(seed)
    origins = torch.rand(count, 3, generator=random, dtype=torch.float64) - 0.5
    ahead = torch.cat([torch.randn(count, 2, generator=random, dtype=torch.float64), -torch.ones(count, 1)], 1)
    return Rays(origins, ahead / ahead.norm(dim=1, keepdim=True))


def coordinates(points: torch.Tensor) -> torch.Tensor:
    """Of points of the world, by the definition."""
    x, y, z = points.unbind(1)
    return torch.stack([-SOME.scale_x * x / z, -SOME.scale_y * y / z, 1 + 2 * SOME.near / z], dim=1)


@given(SEED, st.floats(0, 0.999))
def test_rays_in_ndc_pass_the_same_points(seed, t):
    rays = looking_forward(seed)
    along = torch.full((50,), t, dtype=torch.float64)
    warped = SOME.rays(rays)
    distance = SOME.distances(rays, along, math.inf)
    points = rays.origins + distance[:, None] * rays.directions
    torch.testing.assert_close(warped.origins + t * warped.directions, coordinates(points), rtol=1e-9, atol=1e-9)


@given(SEED)
def test_points_and_their_pace(seed):
    """The pace is the slope of t = (z + 1) / 2 by depth; what is nearer than ``near / 1000`` counts as there."""
    rays = looking_forward(seed)
    depths = torch.linspace(0.05, 40.0, 50, dtype=torch.float64)
    points = (rays.directions / -rays.directions[:, 2:] * depths[:, None]).requires_grad_()
    local, pace = SOME.points(points)
    torch.testing.assert_close(local, coordinates(points), rtol=1e-9, atol=1e-9)
    (slopes,) = torch.autograd.grad(local[:, 2].sum() / 2, points)
    torch.testing.assert_close(pace, -slopes[:, 2], rtol=1e-9, atol=0)
    near = torch.tensor([[0.0, 0.0, -0.001 * SOME.near], [0.0, 0.0, 0.5]], dtype=torch.float64)
    torch.testing.assert_close(*SOME.points(near)[0])


def test_the_image_of_the_reference_camera_fills_the_cube():
    # 8 x 6 pixels, focal length 4: the right edge of the image lies at x = 4/4 of the depth, the top at y = 3/4.
    ndc = NDC(2 * 4 / 8, 2 * 4 / 6, near=2.0)
    corners = torch.tensor([[0.0, 0.0], [8.0, 0.0], [0.0, 6.0], [8.0, 6.0]])
    rays = camera_rays(
        torch.eye(3, 4).expand(4, 3, 4), torch.tensor([[4.0, 4.0, 4.0, 3.0]]).expand(4, 4), *corners.unbind(1)
    )
    warped = ndc.rays(rays)
    expected = torch.tensor([[-1.0, 1.0], [1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    for t in (0.0, 0.5, 1.0):
        torch.testing.assert_close((warped.origins + t * warped.directions)[:, :2], expected)
        torch.testing.assert_close((warped.origins + t * warped.directions)[:, 2], torch.full((4,), 2 * t - 1))
    middle = camera_rays(
        torch.eye(3, 4)[None], torch.tensor([[4.0, 4.0, 4.0, 3.0]]), torch.tensor([4.0]), torch.tensor([3.0])
    )
    # Half way, at z = 0, the depth is twice the near plane's.
    torch.testing.assert_close(ndc.distances(middle, torch.tensor([0.5]), 100.0), torch.tensor([4.0]))
    torch.testing.assert_close(ndc.distances(middle, torch.tensor([1.0]), 100.0), torch.tensor([100.0]))


def scene(turn: float) -> Scene:
    pose = torch.eye(3, 4).repeat(2, 1, 1)
    pose[1, 0, 0], pose[1, 0, 2] = math.cos(turn), math.sin(turn)
    pose[1, 2, 0], pose[1, 2, 2] = -math.sin(turn), math.cos(turn)
    lens = torch.tensor([[4.0, 5.0, 4.0, 3.0]]).repeat(2, 1)
    views = Views(torch.zeros(2, 6, 8, 3, dtype=torch.uint8), pose, lens, ("front", "turned"))
    return Scene("room", views, views, 1.5, 10.0, "forward", "black")


def test_of_a_scene():
    ndc = ndc_of(scene(0.2))
    assert ndc == (1.0, pytest.approx(5 / 3), 1.5)


def test_a_camera_that_looks_sideways_is_named():
    with pytest.raises(DataError, match=r"room: found view turned, which looks sideways or back, expected cameras"):
        ndc_of(scene(1.2))
