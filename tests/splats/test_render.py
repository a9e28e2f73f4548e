"""The plain rasteriser, which GPUs run and loops are compared with, against the formula and against closed forms."""

import math

import pytest
import torch
from gaussian_scenes import FLOOR, LENS, NEAR, certain, of_type, pixel_by_pixel, setting, views_of
from torch import Tensor

from ctm_plugin.rays.cameras import distort, pixel_rays
from ctm_plugin.rays.spherical_harmonics import harmonics
from ctm_plugin.scene.frustum import projected as seen_by
from ctm_plugin.scene.views import Views
from ctm_plugin.splats.gaussians import (
    EPS2D,
    FRAME_MARGINS,
    Camera,
    Gaussians,
    camera_of,
    colors_seen,
    project,
    rotations,
    secants,
)
from ctm_plugin.splats.render import PLANE_CHANNELS, expected_depth, picture

DOUBLE = torch.float64


def one(mean: tuple[float, ...], size: tuple[float, ...], opacity: float, turn=(1.0, 0.0, 0.0, 0.0)) -> Gaussians:
    """One Gaussian of mid grey, in float64."""
    table = {"means": mean, "scales": size, "quats": turn, "opacities": (opacity,), "sh0": (0.0,), "shN": ()}
    return Gaussians(*(torch.tensor([each], dtype=DOUBLE) for each in table.values()))


def straight(width: int = 31, height: int = 25, distortion=None) -> tuple[Camera, Views]:
    """A camera at the origin that looks along -z, as numbers of float64."""
    views = views_of(torch.eye(3, 4)[None], (40.0, 42.0, 15.2, 11.7), width, height, distortion)
    return of_type(camera_of(views, 0, NEAR), DOUBLE), views


def no_shift(gaussians: Gaussians) -> Tensor:
    return torch.zeros(len(gaussians.means), 2, dtype=DOUBLE)


# Composited


@pytest.mark.parametrize(
    "of",
    [
        setting(25, width=21, height=18),
        setting(25, channels=1, degrees=1, lens=True, width=16, height=16),
        setting(40, channels=5, degrees=4, width=19, height=5, opacity=6.0, sizes=(0.0, -1.0, -2.0)),
        setting(40, degrees=2, width=1, height=1, opacity=-5.0),
    ],
)
def test_the_picture_is_the_formula_s(of):
    """Pixel by pixel and Gaussian by Gaussian."""
    expected, expected_left = pixel_by_pixel(of.projected(), of.camera)
    assert certain(of.projected(), of.camera, 1e-9).all()
    _, _, image, left = of.rendered(picture.reference, DOUBLE)
    torch.testing.assert_close(image.detach(), expected, atol=1e-12, rtol=1e-12)
    torch.testing.assert_close(left.detach(), expected_left, atol=1e-12, rtol=1e-12)


def test_nothing_to_see():
    camera, _ = straight()
    behind = one((0.0, 0.0, 1.0), (0.0,) * 3, 9.0)
    none = Gaussians(*(each[:0] for each in behind))
    close, faint = one((0.0, 0.0, -0.9 * NEAR), (0.0,) * 3, 9.0), one((0.0, 0.0, -2.0), (0.0,) * 3, -6.0)
    for gaussians in (none, behind, close, faint):
        for run in (picture.reference, picture):
            image, left = run(gaussians, camera, no_shift(gaussians), 1, FLOOR, PLANE_CHANNELS)
            assert not image.any()
            assert (left == 1).all()


@pytest.mark.parametrize("lens", [False, True])
def test_gradients(lens):
    """Where every alpha is between its bounds, all is smooth. Directions, and a lens' slopes, count as constant."""
    camera, _ = straight(5, 4, LENS if lens else None)
    camera = camera._replace(lens=torch.tensor([4.0, 4.2, 2.6, 1.9], dtype=DOUBLE))
    generator = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=DOUBLE)

    degrees = 2 if lens else 1
    tables = Gaussians(
        0.3 * normal(3, 3) - torch.tensor([0.0, 0.0, 3.0]), 0.2 * normal(3, 3) + 0.2, normal(3, 4), 0.3 * normal(3, 1),
        0.3 * normal(3, 2) + 1, 0.1 * normal(3, 2 * (degrees**2 - 1)),
    )  # fmt: skip
    shift = no_shift(tables)
    assert certain(project(tables, camera, shift, degrees, FLOOR), camera, 0.2).all()

    def rendered(*leaves: Tensor) -> tuple[Tensor, Tensor]:
        means = () if len(leaves) == 7 else (tables.means,)
        *given, moved = (*means, *leaves)
        return picture.reference(Gaussians(*given), camera, moved, degrees, FLOOR, 0)

    leaves = [each.clone().requires_grad_() for each in (*tables[lens:], shift)]
    assert torch.autograd.gradcheck(rendered, leaves)


# Projected


@pytest.mark.parametrize("lens", [None, LENS, (-0.25, 0.06, 0.0, 0.0, 0.0)])
def test_means_lie_where_the_rays_of_their_pixels_go(lens):
    """And where the package projects points elsewhere."""
    _, views = straight(distortion=lens)
    camera = camera_of(views, 0, NEAR)
    pixel = torch.arange(0, 31 * 25, 17)
    rays = pixel_rays(views.c2w, views.intrinsics, 25, 31, pixel, views.distortion)
    places = rays.origins + torch.linspace(1, 9, len(pixel))[:, None] * rays.directions
    gaussians = setting(len(pixel)).gaussians._replace(means=places)
    found = project(gaussians, camera, torch.zeros(len(pixel), 2), 3, FLOOR)
    torch.testing.assert_close(found.means, torch.stack([pixel % 31, pixel // 31], 1) + 0.5, atol=2e-4, rtol=0)
    elsewhere = seen_by(places, views, 0)
    torch.testing.assert_close(found.means, torch.stack(elsewhere[:2], 1), atol=1e-4, rtol=0)
    torch.testing.assert_close(found.depths, elsewhere.depth)
    along = (places * rays.directions).sum(1) / found.depths
    torch.testing.assert_close(secants(camera).flatten()[pixel], along)


@pytest.mark.parametrize("lens", [False, True])
def test_covariances_are_those_of_the_lens_local_map(lens):
    """``J V J' + 0.3``, J by automatic differentiation of where a point of the camera's frame lies on the picture."""
    of = setting(30, lens=lens, spread=0.5)
    camera, tables = of_type(of.camera, DOUBLE), Gaussians(*(each.double() for each in of.gaussians))

    def imaged(point: Tensor) -> Tensor:
        x, y, z = camera.turn @ (point - camera.centre)
        at = torch.stack(distort(x / z, y / z, camera.distortion))
        return camera.lens[:2] * at + camera.lens[2:]

    found, turns = of.projected(), rotations(tables.quats)
    for each in range(30):
        local = camera.turn @ (tables.means[each] - camera.centre)
        assert (local[:2].abs() / local[2] < camera.reach).all()
        jacobian = torch.autograd.functional.jacobian(imaged, tables.means[each])
        spread = turns[each] @ tables.scales[each].exp().diag()
        expected = jacobian @ spread @ spread.T @ jacobian.T + EPS2D * torch.eye(2, dtype=DOUBLE)
        a, b, c = found.conics[each]
        conic = torch.stack([torch.stack([a, b]), torch.stack([b, c])])
        torch.testing.assert_close(conic.inverse(), expected)
        torch.testing.assert_close(found.means[each], imaged(tables.means[each]))
        reach = 2 * (255 * tables.opacities[each].sigmoid()).log()
        torch.testing.assert_close(found.extents[each], (reach * expected.diagonal()).sqrt())


def test_turns_of_any_length_are_rotations():
    turns = torch.randn(20, 4, dtype=DOUBLE, generator=torch.Generator().manual_seed(0))
    found = rotations(turns)
    torch.testing.assert_close(found @ found.mT, torch.eye(3, dtype=DOUBLE).expand(20, 3, 3))
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(20, dtype=DOUBLE))
    torch.testing.assert_close(rotations(7 * turns), found)
    quarter = torch.tensor([[1.0, 0.0, 0.0, 1.0]])  # round z
    torch.testing.assert_close(rotations(quarter)[0] @ torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]))


@pytest.mark.parametrize("lens", [False, True])
def test_far_outside_of_the_frame_the_projection_is_straight(lens):
    """A lens' polynomial folds over there: it would put what lies beside the picture into it."""
    camera, _ = straight(distortion=(-0.6, 0.0, 0.0, 0.0, 0.0) if lens else None)
    x = camera.reach[0] * torch.tensor([0.5, 1.0, 2.0, 3.0, 30.0], dtype=DOUBLE)
    places = torch.stack([x, torch.zeros(5), torch.full((5,), -1.0)], 1)
    gaussians = Gaussians(*(each.repeat(5, 1) for each in one((0.0,) * 3, (-2.0,) * 3, 0.0)))._replace(means=places)
    found = project(gaussians, camera, no_shift(gaussians), 1, FLOOR)
    right = found.means[:, 0] - camera.lens[2]
    assert (right.diff() > 0).all()
    assert (right[2:] - right[1:2] > camera.width / 8).all()
    torch.testing.assert_close((right[3] - right[1]) / (right[2] - right[1]), torch.tensor(2.0, dtype=DOUBLE))
    assert camera.reach[0].item() > (camera.width / 2) / camera.lens[0].item() * FRAME_MARGINS[lens] * 0.99


@pytest.mark.parametrize("degrees", [1, 2, 3, 4])
def test_colors_are_harmonics_of_the_direction(degrees):
    of = setting(20, channels=2, degrees=4)
    gaussians, centre = of.gaussians, of.camera.centre
    found = colors_seen(gaussians, centre, degrees, -9.0)
    basis = harmonics(torch.nn.functional.normalize(gaussians.means - centre, dim=1), degrees)
    every = torch.cat([gaussians.sh0[:, None], gaussians.shN.view(20, 15, 2)], 1)[:, : degrees**2]
    torch.testing.assert_close(found, 0.5 + (basis[..., None] * every).sum(1))
    torch.testing.assert_close(colors_seen(gaussians, centre, degrees, 0.4), found.clamp_min(0.4))


def test_every_second_pixel_is_of_the_same_camera():
    """The first row and column among them; a pixel's ray is the same."""
    _, views = straight(width=31, height=24, distortion=LENS)
    whole, half = (camera_of(views, 0, NEAR, every) for every in (1, 2))
    assert (half.height, half.width) == (12, 16)
    torch.testing.assert_close(secants(half), secants(whole)[::2, ::2])
    gaussians = setting(30, spread=0.5).gaussians
    gaussians = gaussians._replace(means=gaussians.means - torch.tensor([0.0, 0.0, 4.0]))
    of_whole, of_half = (project(gaussians, each, torch.zeros(30, 2), 3, FLOOR) for each in (whole, half))
    torch.testing.assert_close((of_half.means - 0.5) * 2, of_whole.means - 0.5, atol=1e-3, rtol=1e-4)


# Depth


@pytest.mark.parametrize("lens", [None, LENS])
@pytest.mark.parametrize("angle", [0.0, 0.7, -1.0])
def test_a_wall_is_as_far_as_its_plane(angle, lens):
    """One wide thin Gaussian, slanted: distances along the rays, not those of its middle."""
    camera, views = straight(distortion=lens)
    turn = (math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0)  # round y
    wall = one((0.1, -0.1, -4.0), (0.5, 0.5, -7.0), 9.0, turn)
    image, left = picture.reference(wall, camera, no_shift(wall), 1, FLOOR, PLANE_CHANNELS)
    narrow = camera_of(views, 0, NEAR)
    depth = expected_depth(image.float(), left.float(), narrow, 50.0)
    depth = (depth - 50 * left) / (1 - left)
    rays = pixel_rays(views.c2w, views.intrinsics, 25, 31, torch.arange(31 * 25), views.distortion)
    normal = rotations(wall.quats)[0, :, 2].float()
    expected = ((wall.means[0].float() @ normal) / (rays.directions @ normal)).view(25, 31)
    middle = torch.zeros(25, 31, dtype=torch.bool)
    middle[8:18, 11:22] = True
    assert left[middle].max() < 0.5
    assert expected[middle].std() > 0.25 * abs(angle)
    assert (depth / expected - 1).abs()[middle].max() < 0.02 + 0.02 * abs(angle)


def test_light_that_nothing_stops_comes_from_far():
    _, views = straight()
    camera = camera_of(views, 0, NEAR)
    ahead = secants(camera)
    clear = expected_depth(torch.zeros(5, 25, 31), torch.ones(25, 31), camera, 50.0)
    assert (clear == 50).all()
    image = torch.zeros(5, 25, 31)
    image[-3], image[-2], image[-1] = 0.5 * 3.0, 0.5 * 0.01, 0.5 * -0.02  # half of the light stopped by a plane
    found = expected_depth(image, torch.full((25, 31), 0.5), camera, 50.0)
    assert found[5, 29].item() == pytest.approx(0.5 * (3 + 0.01 * 14 + 0.02 * 7) * ahead[5, 29].item() + 25, rel=1e-5)
