"""DVGO's field in NDC against a renderer in float64, and against what a fresh grid and an opaque plane must give."""

import math

import pytest
import torch

from ctm_plugin.backbones.multiplane import BASE_PLANES, MultiplaneField, plane_shape
from ctm_plugin.backbones.voxels import ViewMLP
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.ndc import NDC

COORDINATES = NDC(scale_x=1.2, scale_y=1.5, near=0.9)
FAR = 12.0
BOX = torch.tensor([[-1.3, -1.2, -1.0], [1.3, 1.2, 1.0]])
SHAPE = (6, 5, 8)
FEATURES = 4


def world_of(point: torch.Tensor) -> torch.Tensor:
    """The point of the world with these coordinates."""
    x, y, z = point
    depth = 2 * COORDINATES.near / (1 - z)
    return torch.stack([x * depth / COORDINATES.scale_x, y * depth / COORDINATES.scale_y, -depth])


def make_field(planes: int = SHAPE[2], step: float = 1.0, threshold: float = 1e-12) -> MultiplaneField:
    shape = (*SHAPE[:2], planes)
    return MultiplaneField(BOX, shape, FEATURES, ndc=COORDINATES, far=FAR, threshold=threshold, step=step)


def random_field(step: float = 1.0) -> MultiplaneField:
    random = torch.Generator().manual_seed(1)
    field = make_field(step=step)
    with torch.no_grad():
        field.density.copy_(2 * torch.randn(field.density.shape, generator=random) - 1)
        field.features.copy_(2 * torch.randn(field.features.shape, generator=random))
    return field


def rays_ahead(count: int = 30) -> Rays:
    random = torch.Generator().manual_seed(0)
    origins = 0.3 * torch.rand(count, 3, generator=random) - 0.15
    directions = torch.cat([0.6 * torch.rand(count, 2, generator=random) - 0.3, -torch.ones(count, 1)], dim=1)
    return Rays(origins, directions / directions.norm(dim=1, keepdim=True))


@pytest.mark.parametrize("planes", [8, 64, 256])
def test_a_fresh_grid_gives_all_planes_the_same_weight(planes):
    field, rays = make_field(planes), Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0.0, -1.0]]))
    _, _, samples = field(rays, torch.zeros(1, FEATURES), 0.0, None)
    # The last plane lies at t = 1, where the ray ends: its weight is what passes.
    torch.testing.assert_close(samples.weights, torch.full((planes - 1,), 1 / planes), atol=2e-6, rtol=0)
    assert samples.transmittance.item() == pytest.approx(1 / planes, abs=1e-5 * planes)
    torch.testing.assert_close(samples.t, torch.arange(planes - 1) / (planes - 1))


def test_half_a_step_has_half_the_optical_depth():
    whole, half = make_field(step=1.0), make_field(step=0.5)
    raw = torch.tensor([-2.0, 0.0, 3.0])
    torch.testing.assert_close(half.optical_depth(raw, 0.3), whole.optical_depth(raw, 0.3) / 2)
    assert whole.optical_depth(raw, 0.0)[1].item() == pytest.approx(math.log(2) * BASE_PLANES / SHAPE[2])


@pytest.mark.parametrize("step", [1.0, 0.3])
@pytest.mark.parametrize("kind", ["mlp", "features"])
def test_slow_renderer(step, kind):
    torch.manual_seed(5)
    mlp = ViewMLP(FEATURES, 3, width=8, depth=3, frequencies=2) if kind == "mlp" else None
    field, rays = random_field(step), rays_ahead()
    background = torch.rand(1, 3 if mlp else FEATURES)
    latent, depth, samples = field(rays, background, 0.25, mlp)

    warped = COORDINATES.rays(Rays(rays.origins.double(), rays.directions.double()))
    low, spacing = BOX[0].double(), (BOX[1] - BOX[0]).double() / (torch.tensor(SHAPE) - 1)
    tables = [table.detach().double().reshape(*SHAPE, -1) for table in (field.density, field.features)]
    shift = field.vertex_shift.double()

    def at(table, point):
        position = (point - low) / spacing
        first = torch.minimum(position.floor(), torch.tensor(SHAPE) - 2.0).long()
        part = position - first
        total = 0.0
        for i, j, k in torch.cartesian_prod(*[torch.arange(2)] * 3).tolist():
            corner = torch.tensor([i, j, k])
            weight = torch.where(corner == 1, part, 1 - part).prod()
            total = total + weight * table[tuple((first + corner).tolist())]
        return total

    for index in range(len(rays.origins)):
        light, expected, distance, t = 1.0, 0.0, 0.0, 0.25 * step / (SHAPE[2] - 1)
        while t < 1 - 1e-9:
            point = warped.origins[index] + t * warped.directions[index]
            if ((point >= BOX[0] - 1e-9) & (point <= BOX[1] + 1e-9)).all():
                density = at(torch.cat([tables[0], shift.expand(*SHAPE)[..., None]], dim=-1), point).sum()
                alpha = 1 - math.exp(-math.log1p(math.exp(density)) * step * BASE_PLANES / SHAPE[2])
                features = at(tables[1], point)
                seen = (
                    features.sigmoid()
                    if mlp is None
                    else mlp(features.float()[None], rays.directions[index][None], torch.tensor([0]))[0].double()
                )
                world = world_of(point)
                away = (world - rays.origins[index].double()).norm().item()
                distance = distance + light * alpha * min(away, FAR)
                expected = expected + light * alpha * seen
                light *= 1 - alpha
            t += step / (SHAPE[2] - 1)
        torch.testing.assert_close(latent[index].double(), expected + light * background[0].double(), atol=2e-5, rtol=0)
        assert depth[index].item() == pytest.approx(distance + light * FAR, abs=1e-3)
        assert samples.transmittance[index].item() == pytest.approx(light, abs=1e-5)


@pytest.mark.parametrize("plane", [0, 3, 6])
def test_depth_of_an_opaque_plane_is_a_distance_in_the_world(plane):
    field, rays = make_field(), rays_ahead()
    with torch.no_grad():
        density = field.density.view(*SHAPE, 1)
        density[:] = -100.0
        density[:, :, plane] = 100.0
    _, depth, _ = field(rays, torch.zeros(1, FEATURES), 0.0, None)
    # The sample on the plane itself takes all light: depth -z there is near / (1 - t).
    z = -COORDINATES.near / (1 - plane / (SHAPE[2] - 1))
    torch.testing.assert_close(depth, ((z - rays.origins[:, 2]) / rays.directions[:, 2]).clamp_max(FAR))


def test_hits_miss_no_ray():
    field, rays = make_field(planes=40), rays_ahead(500)
    for seed in range(20):
        field.occupancy[:] = torch.rand(len(field.occupancy), generator=torch.Generator().manual_seed(seed)) < 0.02
        found = torch.zeros(500, dtype=torch.bool)
        found[field.occupied_samples(field.local(rays), 0.5)[1]] = True
        assert 0 < found.sum() < 500
        assert not (found & ~field.hits(rays)).any()


@pytest.mark.parametrize(
    ("voxels", "planes", "expected"), [(16 * 12 * 10, 10, (16, 12)), (8, 8, (2, 2)), (64 * 48 * 64, 64, (64, 48))]
)
def test_plane_shape(voxels, planes, expected):
    box = torch.tensor([[-2.0, -1.5, -1.0], [2.0, 1.5, 1.0]])
    assert plane_shape(box, voxels, planes) == (*expected, planes)
