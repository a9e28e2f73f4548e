"""Fields that skip empty space against a loop in float64 over their rays' samples, in all three spaces."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from ctm_plugin.backbones.occupied import OccupiedField
from ctm_plugin.backbones.spaces import Box, space_of
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.rays.cameras import Rays, pixel_rays
from ctm_plugin.rays.contraction import contract
from ctm_plugin.rays.grid import VoxelGrid, cubic_shape
from ctm_plugin.scene.frustum import ndc_of
from ctm_plugin.scene.kinds import GEOMETRIES
from ctm_plugin.scene.views import Scene

SAMPLES, RAYS = 60, 40


@pytest.fixture(params=GEOMETRIES)
def scene(request, ball, wall) -> Scene:
    bounded = BlenderConfig(root=ball).load()
    return wall if request.param == "forward" else dataclasses.replace(bounded, geometry=request.param)


def rays_of(scene: Scene, count: int = RAYS) -> Rays:
    views = scene.train
    pixel = torch.randint(views.images[..., 0].numel(), (count,), generator=torch.Generator().manual_seed(2))
    return pixel_rays(views.c2w, views.intrinsics, views.height, views.width, pixel)


def lumps(points: Tensor) -> Tensor:
    """A density everywhere, and a thick ball."""
    return 1 + 3 * (points * 2).sin().prod(-1).abs() + 20 * (points.norm(dim=-1) < 0.7)


def color(points: Tensor, directions: Tensor) -> Tensor:
    return (points - 2 * directions).sigmoid()


class Painted(OccupiedField):
    """Of a density and of :func:`color`."""

    def __init__(self, space: Box, density=lumps, threshold: float = 1e-6, samples: int = SAMPLES):
        super().__init__(space, VoxelGrid(space.aabb, cubic_shape(space.aabb, 8**3)), threshold)
        space.divide(space.longest / samples)
        self.density = density

    def evaluate(self, points):
        return self.density(points), lambda index, directions, ray: color(points[index], directions[ray])


def painted(scene: Scene, **settings) -> Painted:
    return Painted(space_of(scene, scene.geometry), **settings)


def by_hand(scene: Scene, space: Box, rays: Rays, ray: int, offset: float) -> list[tuple[float, Tensor, float]]:
    """Distances in the world, points of the space and lengths in its measure of all samples of a ray."""
    origin, direction = rays.origins[ray].double(), rays.directions[ray].double()
    low, high = space.aabb.double()
    found = []
    if scene.geometry == "unbounded":
        centre, radius = space.centre.double(), space.radius
        near = scene.near / radius
        pace, step = near if near <= 2 else 4 - 4 / near, 4 / SAMPLES
        while (at := pace + (len(found) + offset) * step) < 4 - step:
            far = at if at <= 2 else 4 / (4 - at)
            x = (origin - centre) / radius + far * direction
            norm = max(1.0, x.norm().item())
            length = max(1.0, far / 2) ** 2 / norm**2 * step / 4
            found.append((min(far * radius, scene.far), (2 - 1 / norm) * x / norm, length))
        return found
    if scene.geometry == "forward":
        line = ndc_of(scene).rays(rays)
        for t in ((index + offset) / SAMPLES for index in range(SAMPLES)):
            point = line.origins[ray].double() + t * line.directions[ray].double()
            distance = (-scene.near / (1 - t) - origin[2].item()) / direction[2].item()
            found.append((min(distance, scene.far), point, 1 / SAMPLES))
        return found
    step = (high - low).norm().item() / SAMPLES
    sides = torch.stack([(low - origin) / direction, (high - origin) / direction])
    enter, leave = max(scene.near, sides.amin(0).max().item()), min(scene.far, sides.amax(0).min().item())
    while (t := enter + (len(found) + offset) * step) < leave:
        found.append((t, origin + t * direction, step / (high - low).max().item()))
    return found


@pytest.mark.parametrize("threshold", [1e-6, 0.03])
@pytest.mark.parametrize("jitter", [False, True], ids=["middle", "jitter"])
def test_rendering(scene, threshold, jitter):
    """Every sample of every ray; those with less alpha, or less weight, than the threshold count for nothing."""
    field, rays = painted(scene, threshold=threshold), rays_of(scene)
    background, offset = torch.rand(RAYS, 3), torch.rand(RAYS) if jitter else torch.full((RAYS,), 0.5)
    latent, depth, samples = field(rays, background, offset if jitter else 0.5)
    for ray in range(RAYS):
        light, seen, far = 1.0, torch.zeros(3, dtype=torch.float64), 0.0
        for distance, point, length in by_hand(scene, field.space, rays, ray, offset[ray].item()):
            alpha = 1 - math.exp(-lumps(point[None]).item() * length)
            if alpha > threshold:
                weight, light = light * alpha, light * (1 - alpha)
                far += weight * distance
                seen += (weight > threshold) * weight * color(point, rays.directions[ray].double())
        expected = seen + light * background[ray].double()
        torch.testing.assert_close(latent[ray].double(), expected, atol=3e-4 if threshold < 1e-3 else 0.04, rtol=0)
        assert depth[ray].item() == pytest.approx(far + light * scene.far, rel=2e-3 if threshold < 1e-3 else 0.05)
        assert samples.transmittance[ray].item() == pytest.approx(light, abs=2e-4 if threshold < 1e-3 else 0.04)
    sums = torch.zeros(RAYS, 3).index_add_(0, samples.ray_index, samples.weights[:, None] * samples.latent)
    torch.testing.assert_close(latent, sums + samples.transmittance[:, None] * background)
    assert (samples.weights > threshold).all()
    assert not depth.requires_grad


@pytest.mark.parametrize("empty", ["thin", "free"])
def test_light_that_nothing_stops_comes_from_far(scene, empty):
    field = painted(scene, density=lambda points: torch.full_like(points[:, 0], 0.0 if empty == "thin" else 9.0))
    field.occupancy[:] = empty == "thin"
    latent, depth, samples = field(rays_of(scene), torch.full((1, 3), 0.5), 0.5)
    assert (latent == 0.5).all()
    assert depth.tolist() == [scene.far] * RAYS
    assert (samples.transmittance == 1).all()
    assert len(samples.weights) == len(samples.latent) == len(samples.ray_index) == 0


def test_samples_are_those_whose_nearest_vertex_is_occupied(scene):
    field, rays, offset = painted(scene), rays_of(scene), torch.rand(RAYS)
    local = field.space.local(rays)
    every = field.samples(local, offset)
    points = every[2]
    low, high = field.space.aabb
    assert ((points >= low - 1e-4) & (points <= high + 1e-4)).all()
    cells = torch.rand(len(field.occupancy)) < 0.5
    kept = cells[field.grid.nearest(points)]
    for found, expected in zip(field.samples(local, offset, cells), every, strict=True):
        assert torch.equal(found, expected[kept])  # each by itself, by the same machine code
    field.occupancy = cells
    assert len(field.samples(local, offset)[0]) == kept.sum()


def test_hits_miss_no_ray(scene):
    field, rays = painted(scene), rays_of(scene, 500)
    for seed in range(20):
        field.occupancy = torch.rand(len(field.occupancy), generator=torch.Generator().manual_seed(seed)) < 0.01
        found = torch.zeros(500, dtype=torch.bool)
        found[field.samples(field.space.local(rays), 0.5)[1]] = True
        assert not (found & ~field.hits(rays)).any()
    assert found.any()
    field.occupancy[:] = False
    assert not field.hits(rays).any()


def test_query_is_density_a_unit_of_length(scene):
    """Of the world, in NDC of depth: the optical depth of a short way divided by its length."""
    field, rays = painted(scene), rays_of(scene)
    field.space.divide(field.space.longest / 10_000)
    t, ray, points = field.samples(field.space.local(rays), 0.5)
    ends = [field.space.distances(rays, t + side * field.space.stride / 2, ray) for side in (-1, 1)]
    some = (ends[1] < 0.5 * scene.far) & (torch.rand(len(t)) < 1e-2)
    if scene.geometry == "forward":
        ends = [end * -rays.directions[ray, 2] for end in ends]
    depth = field.evaluate(points)[0] * field.space.lengths(t, points)
    middle = field.space.distances(rays, t, ray)[:, None]
    found, latent = field.query((rays.origins[ray] + middle * rays.directions[ray])[some], rays.directions[ray][some])
    loose = {"bounded": 0.02, "forward": 0.02, "unbounded": 0.5}[scene.geometry]
    expected = (depth / (ends[1] - ends[0]))[some]
    assert some.sum() > 100
    assert (found / expected).log().abs().median() < loose
    torch.testing.assert_close(latent, color(points, rays.directions[ray])[some], atol=1e-3, rtol=0)


def test_a_query_outside_or_in_free_space_finds_nothing(scene):
    field, points = painted(scene), torch.randn(50, 3) - torch.tensor([0.0, 0.0, 6.0])
    density = field.query(points, torch.tensor([[0.0, 0.0, -1.0]]).expand(50, 3))[0]
    low, high = field.space.aabb
    local = field.space.place(points)[0]
    assert torch.equal(density > 0, ((local >= low) & (local <= high)).all(1))
    field.occupancy[:] = False
    assert not field.query(points, torch.tensor([[0.0, 0.0, -1.0]]).expand(50, 3))[0].any()


@pytest.mark.parametrize("distance", [1.5, 5.0, 40.0])
def test_without_bounds_near_and_far_walls_are_where_they_are(ball, distance):
    """Shells of radius ``distance`` round the middle, seen from inside or from outside."""
    scene = dataclasses.replace(BlenderConfig(root=ball).load(), geometry="unbounded", near=0.5, far=100.0)
    space, rays = space_of(scene, "unbounded"), rays_of(scene)
    edge, inside = float(contract(torch.tensor([distance / space.radius, 0.0, 0.0]))[0]), distance >= 4
    field = Painted(space, lambda points: ((points.norm(dim=-1) > edge) == inside) * 1e6, samples=2000)
    _, depth, _ = field(rays, torch.zeros(1, 3), 0.5)
    origin = rays.origins - space.centre
    middle = (origin * rays.directions).sum(1)
    under = middle.square() - origin.square().sum(1) + distance**2
    hit = under > 0.1
    assert hit.sum() > 20
    expected = -middle + (1 if inside else -1) * under.clamp_min(0).sqrt()
    # A sample is 4/2000 of pace long: in the world that times the square of distance over twice the radius, at least.
    longest = 2 * space.radius * 4 / 2000 * max(1.0, (expected[hit].max().item() / space.radius / 2) ** 2)
    assert (depth - expected)[hit].abs().max() < longest
