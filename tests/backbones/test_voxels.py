"""DVGO's field: its samples against a lookup in float64, its free space, its growth."""

import math
from copy import deepcopy

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.backbones.dvgo import BASE_PLANES, plane_shift
from ctm_plugin.backbones.networks import ViewMLP
from ctm_plugin.backbones.spaces import Box, NDCSpace
from ctm_plugin.backbones.voxels import VoxelField
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.ndc import NDC

BOX = torch.tensor([[-1.0, -0.5, -2.0], [1.0, 1.25, 0.5]])
SHAPE = (5, 4, 6)
NEAR, FAR, FEATURES = 0.5, 6.0, 4
TINY = 1e-12
ALPHA = 0.1


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_rays(count: int, seed: int = 0) -> Rays:
    """Rays from outside towards points in and about the box."""
    rng = generator(seed)
    origins = 3 * F.normalize(torch.randn(count, 3, generator=rng), dim=1)
    aims = BOX[0] + (1.4 * torch.rand(count, 3, generator=rng) - 0.2) * (BOX[1] - BOX[0])
    return Rays(origins, F.normalize(aims - origins, dim=1))


def make_color() -> ViewMLP:
    torch.manual_seed(5)
    return ViewMLP(FEATURES, 3, width=8, depth=3, frequencies=2)


def make_field(threshold: float = TINY, seed: int = 1, planes: bool = False, direct: bool = True) -> VoxelField:
    space = NDCSpace(BOX, NDC(1.2, 1.5, 0.9), FAR) if planes else Box(BOX, NEAR, FAR, FAR)
    space.measure = 0.6
    shift = torch.linspace(-2, 1, SHAPE[2]) if planes else math.log(1 / (1 - ALPHA) - 1)
    field = VoxelField(space, SHAPE, FEATURES, make_color(), direct=direct, alpha_thre=threshold, step=0.5, shift=shift)
    with torch.no_grad():
        field.density.copy_(3 * torch.randn(field.density.shape, generator=generator(seed)) + 1)
        field.features.copy_(2 * torch.randn(field.features.shape, generator=generator(seed + 1)))
    return field


def by_hand(field: VoxelField, points: torch.Tensor, density: torch.Tensor, features: torch.Tensor):
    """Density and features of points, corner by corner, differentiable in the tables."""
    low, spacing = BOX[0].double(), (BOX[1] - BOX[0]).double() / (torch.tensor(SHAPE) - 1)
    shift = torch.as_tensor(field.vertex_shift).double().expand(SHAPE)[..., None]
    tables = [(density.view(*SHAPE, 1) + shift), features.view(*SHAPE, -1)]
    found = []
    for point in points.double():
        position = (point - low) / spacing
        first = torch.minimum(position.floor(), torch.tensor(SHAPE) - 2.0).long()
        part, total = position - first, [0.0, 0.0]
        for corner in torch.cartesian_prod(*[torch.arange(2)] * 3):
            weight = torch.where(corner == 1, part, 1 - part).prod()
            total = [each + weight * table[tuple(first + corner)] for each, table in zip(total, tables, strict=True)]
        found.append(torch.cat([F.softplus(total[0]), total[1]]))
    return torch.stack(found).split([1, FEATURES], dim=1)


@pytest.mark.parametrize("planes", [False, True], ids=["voxels", "planes"])
@pytest.mark.parametrize("direct", [False, True], ids=["network", "direct"])
def test_evaluation_and_its_gradients(planes, direct):
    """Interpolated first, activated after; only the asked-for samples are shaded."""
    field = make_field(planes=planes, direct=direct)
    points = BOX[0] + torch.rand(30, 3, generator=generator(3)) * (BOX[1] - BOX[0])
    index, directions = torch.arange(0, 30, 2), random_rays(4).directions
    ray = torch.randint(4, (15,), generator=generator(4))
    density, shade = field.evaluate(points)
    latent = shade(index, directions, ray)
    tables = [table.detach().double().requires_grad_() for table in (field.density, field.features)]
    raw, features = by_hand(field, points, *tables)
    shaded = (
        features[index].sigmoid()
        if direct
        else deepcopy(field.color).double()(features[index], directions.double(), ray)
    )
    torch.testing.assert_close(density.double(), raw.squeeze(1), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(latent.double(), shaded, atol=1e-5, rtol=0)
    weights = torch.randn(30, generator=generator(5))
    ((density * weights).sum() + latent.square().sum()).backward()
    ((raw.squeeze(1) * weights).sum() + shaded.square().sum()).backward()
    for found, expected in zip((field.density, field.features), tables, strict=True):
        assert expected.grad.norm() > 0.01
        torch.testing.assert_close(found.grad.double(), expected.grad, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("alpha_init", [1e-6, 0.01, 0.5])
def test_fresh_grid(alpha_init):
    for interval in (1.0, 0.25):
        space, shift = Box(BOX, NEAR, FAR, FAR), math.log(1 / (1 - alpha_init) - 1)
        space.measure = 0.5 * space.spacing(SHAPE) / interval
        field = VoxelField(space, SHAPE, 3, make_color(), alpha_thre=1e-4, step=0.5, shift=shift)
        expected = torch.full(SHAPE, 1 - (1 - alpha_init) ** interval)
        torch.testing.assert_close(field.alpha(), expected, rtol=1e-4, atol=0)
        assert field.occupancy.all()


@pytest.mark.parametrize("planes", [8, 64, 256])
def test_a_fresh_grid_gives_all_planes_the_same_weight(planes):
    space = NDCSpace(torch.tensor([[-1.3, -1.2, -1.0], [1.3, 1.2, 1.0]]), NDC(1.2, 1.5, 0.9), FAR)
    space.measure, shift = planes / (planes - 1) / BASE_PLANES, plane_shift(planes)
    field = VoxelField(space, (6, 5, planes), 3, make_color(), direct=True, alpha_thre=TINY, step=1.0, shift=shift)
    rays = Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0.0, -1.0]]))
    _, _, samples = field(rays, torch.zeros(1, 3), 0.0)
    # The last plane lies at t = 1, where the ray ends: its weight is what passes.
    torch.testing.assert_close(samples.weights, torch.full((planes - 1,), 1 / planes), atol=2e-6, rtol=0)
    assert samples.transmittance.item() == pytest.approx(1 / planes, abs=1e-5 * planes)
    torch.testing.assert_close(samples.t, torch.arange(planes - 1) / (planes - 1))


@pytest.mark.parametrize("plane", [0, 3, 6])
def test_depth_of_an_opaque_plane_is_a_distance_in_the_world(plane):
    space = NDCSpace(torch.tensor([[-1.3, -1.2, -1.0], [1.3, 1.2, 1.0]]), ndc := NDC(1.2, 1.5, 0.9), FAR)
    field = VoxelField(space, (6, 5, 8), 3, make_color(), direct=True, alpha_thre=TINY, step=1.0, shift=torch.zeros(8))
    field.density.data.fill_(-100.0).view(6, 5, 8)[:, :, plane] = 100.0
    directions = F.normalize(torch.tensor([[0.1, -0.2, -1.0], [0.0, 0.3, -1.0]]), dim=1)
    rays = Rays(torch.tensor([[0.1, 0.0, 0.1], [0.0, -0.1, -0.1]]), directions)
    _, depth, _ = field(rays, torch.zeros(1, 3), 0.0)
    # The sample on the plane itself takes all light: depth -z there is near / (1 - t).
    z = -ndc.near / (1 - plane / 7)
    torch.testing.assert_close(depth, ((z - rays.origins[:, 2]) / rays.directions[:, 2]).clamp_max(FAR))


@pytest.mark.parametrize("planes", [False, True], ids=["voxels", "planes"])
def test_alpha_is_of_one_sample_at_each_vertex(planes):
    field = make_field(planes=planes)
    vertices = field.grid.vertices()
    density = field.evaluate(vertices)[0]
    alpha = 1 - torch.exp(-density * field.space.lengths(vertices[:, 0], vertices))
    torch.testing.assert_close(field.alpha().flatten(), alpha, atol=1e-5, rtol=1e-4)


def blob_field(threshold: float, seed: int) -> VoxelField:
    """Mostly free space, some vertices solid."""
    field = make_field(threshold, seed=seed)
    with torch.no_grad():
        solid = torch.rand(field.density.shape, generator=generator(seed)) < 0.04
        field.density.copy_(torch.where(solid, field.density + 4, -20.0))
    return field


@given(st.integers(0, 10**6))
def test_free_space_changes_nothing(seed):
    field, rays, background = blob_field(1e-3, seed), random_rays(50, seed), torch.rand(50, FEATURES)
    before = field(rays, background, 0.5)
    visited = len(field.samples(rays, 0.5)[0])
    field.update_occupancy()
    if field.occupancy.any() and not field.occupancy.all():
        assert len(field.samples(rays, 0.5)[0]) < visited
    after = field(rays, background, 0.5)
    torch.testing.assert_close(after[:2], before[:2])
    torch.testing.assert_close(after[2].weights, before[2].weights)


@given(st.integers(0, 10**6), st.floats(1e-4, 0.5))
def test_occupancy(seed, threshold):
    field = blob_field(threshold, seed)
    known_free = torch.rand(field.occupancy.shape, generator=generator(seed)) < 0.2
    field.occupancy &= ~known_free
    field.update_occupancy()
    alpha = field.alpha().numpy()
    for row, (x, y, z) in enumerate(np.ndindex(SHAPE)):
        around = alpha[max(x - 1, 0) : x + 2, max(y - 1, 0) : y + 2, max(z - 1, 0) : z + 2]
        assert field.occupancy[row] == (around.max() > threshold and not known_free[row])


def linear(points: torch.Tensor, channels: int) -> torch.Tensor:
    return points @ torch.randn(3, channels, generator=generator(0)) + 0.3


@pytest.mark.parametrize("shape", [(9, 3, 7), SHAPE, (2, 2, 2)], ids=str)
def test_resize_keeps_a_linear_field(shape):
    field = make_field()
    tables = field.density, field.features
    for table in tables:
        table.data = linear(field.grid.vertices(), table.shape[1])
        table.grad = torch.ones_like(table)
    field.resize(shape)
    assert (field.density, field.features) == tables
    assert field.grid.shape == shape
    assert field.grid.voxel == pytest.approx((8.75 / math.prod(shape)) ** (1 / 3))
    assert field.space.stride == pytest.approx(0.5 * field.grid.voxel)
    assert torch.equal(field.grid.aabb, BOX)
    for table in tables:
        torch.testing.assert_close(table.data, linear(field.grid.vertices(), table.shape[1]), atol=1e-5, rtol=0)
        assert table.grad is None
        assert table.requires_grad
    assert len(field.occupancy) == math.prod(shape)


@given(st.integers(0, 10**6), st.tuples(*[st.integers(2, 10)] * 3))
def test_resize_keeps_what_is_there(seed, shape):
    field = blob_field(1e-3, seed)
    field.update_occupancy()
    free = ~field.occupancy
    nearest = field.grid.nearest
    field.resize(shape)
    assert field.occupancy[(field.alpha() > 1e-3).flatten()].all()
    assert not field.occupancy[free[nearest(field.grid.vertices())]].any()
    assert not field.occupancy[field.dilated_alpha() <= 1e-3].any()
