"""NGP: its rendering against a loop in float64 in three geometries, free space, settings, whole runs."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from ctm_plugin.backbones.ngp import NGP
from ctm_plugin.backbones.ngp_field import GEOMETRY
from ctm_plugin.backbones.settings import NGPConfig
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.draws import Draws
from ctm_plugin.errors import ConfigError
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.contraction import contract
from ctm_plugin.runs.train import train
from ctm_plugin.scene.frustum import ndc_of
from ctm_plugin.scene.kinds import GEOMETRIES
from ctm_plugin.scene.views import Scene, Views

SMALL = {
    "rays": 32, "samples": 60, "levels": 3, "log2_entries": 10, "coarsest": 4, "finest": 16, "width": 16, "degrees": 2,
    "cells": 512,
}  # fmt: skip


@pytest.fixture(scope="module")
def scene(ball) -> Scene:
    return BlenderConfig(root=ball).load()


@pytest.fixture(scope="module")
def forward() -> Scene:
    """Cameras in a plane that look along -z, with noise for pictures."""
    random = torch.Generator().manual_seed(0)
    c2w = torch.eye(3, 4).repeat(6, 1, 1)
    c2w[:, :2, 3] = 0.3 * torch.randn(6, 2, generator=random)
    images = torch.randint(256, (6, 8, 10, 3), generator=random, dtype=torch.uint8)
    views = Views(images, c2w, torch.tensor([[9.0, 9.0, 5.0, 4.0]]).repeat(6, 1), tuple("abcdef"))
    return Scene("wall", views, views, near=1.0, far=20.0, geometry="forward", background="black")


@pytest.fixture(params=GEOMETRIES)
def each(request, scene, forward) -> Scene:
    return forward if request.param == "forward" else dataclasses.replace(scene, geometry=request.param)


def make(scene: Scene, **settings) -> NGP:
    return NGP(NGPConfig(geometry=scene.geometry, **SMALL | settings), scene)


def some_rays(module: NGP, count: int = 40) -> Rays:
    return module.training_rays(torch.randint(len(module.pixels), (count,), generator=torch.Generator().manual_seed(2)))


def put(module: NGP, density) -> None:
    """A density, in sides of the space's box and of points of the space, and colours of the depth network's place."""
    field = module.field

    def geometry(t: Tensor, points: Tensor, features: None) -> tuple[Tensor, Tensor]:
        out = torch.zeros(len(points), GEOMETRY)
        out[:, :3] = points
        return density(points) * field.space.lengths(t, points), out

    field.geometry, field.lit = geometry, every_sample
    field.color = _Points()


def every_sample(t: Tensor, *_) -> tuple[Tensor, None]:
    """All of them lit, as far as is known; of features nothing."""
    return torch.arange(len(t)), None


class _Points(torch.nn.Module):
    """Where a sample is, as its latent."""

    def forward(self, features: Tensor, directions: Tensor, ray_index: Tensor) -> Tensor:
        return features[:, :3].sigmoid()


def by_hand(scene: Scene, module: NGP, ray: int, rays: Rays) -> list[tuple[float, Tensor, float]]:
    """Distances in the world, points of the space and lengths in its sides, of all samples of a ray, by definition."""
    origin, direction = rays.origins[ray].double(), rays.directions[ray].double()
    samples, low, high = SMALL["samples"], *module.field.space.box.double()
    found = []
    if scene.geometry == "unbounded":
        centre, radius = module.field.space.centre.double(), module.field.space.radius
        near = scene.near / radius
        pace, step = near if near <= 2 else 4 - 4 / near, 4 / samples
        while (at := pace + (len(found) + 0.5) * step) < 4 - step:
            far = at if at <= 2 else 4 / (4 - at)
            x = (origin - centre) / radius + far * direction
            norm = max(1.0, x.norm().item())
            length = max(1.0, far / 2) ** 2 / norm**2 * step / 4
            found.append((min(far * radius, scene.far), (2 - 1 / norm) * x / norm, length))
        return found
    if scene.geometry == "forward":
        line = ndc_of(scene).rays(rays)
        for index in range(samples):
            t = (index + 0.5) / samples
            point = line.origins[ray].double() + t * line.directions[ray].double()
            distance = (-scene.near / (1 - t) - origin[2].item()) / direction[2].item()
            found.append((min(distance, scene.far), point, 1 / samples))
        return found
    step = (high - low).norm().item() / samples
    sides = torch.stack([(low - origin) / direction, (high - origin) / direction])
    enter, leave = max(scene.near, sides.amin(0).max().item()), min(scene.far, sides.amax(0).min().item())
    while (t := enter + (len(found) + 0.5) * step) < leave:
        found.append((t, origin + t * direction, step / (high - low).max().item()))
    return found


def test_rendering(each):
    """Every sample of every ray, in every geometry."""
    module = make(each, threshold=1e-6)

    def density(points: Tensor) -> Tensor:
        return 1 + 3 * (points * 2).sin().prod(-1).abs() + 20 * (points.norm(dim=-1) < 0.7)

    put(module, density)
    rays, background = some_rays(module), torch.rand(40, 3)
    found = module.render(rays, background, None)
    for ray in range(40):
        light, color, depth = 1.0, torch.zeros(3, dtype=torch.float64), 0.0
        for distance, point, length in by_hand(each, module, ray, rays):
            alpha = 1 - math.exp(-density(point[None]).item() * length)
            color += light * alpha * point.sigmoid()
            depth += light * alpha * distance
            light *= 1 - alpha
        color, depth = color + light * background[ray].double(), depth + light * each.far
        torch.testing.assert_close(found.latent[ray].double(), color, atol=2e-4, rtol=0)
        assert found.depth[ray].item() == pytest.approx(depth, rel=2e-3)
        assert found.opacity[ray].item() == pytest.approx(1 - light, abs=2e-4)


@pytest.mark.parametrize("distance", [1.5, 5.0, 40.0])
def test_without_bounds_near_and_far_walls_are_where_they_are(scene, distance):
    """Shells of radius ``distance`` round the middle, seen from inside or from outside."""
    module = make(dataclasses.replace(scene, geometry="unbounded", near=0.5, far=100.0), samples=2000)
    space = module.field.space
    edge = float(contract(torch.tensor([distance / space.radius, 0.0, 0.0]))[0])
    put(module, lambda points: (points.norm(dim=-1) > edge) * 1e6)
    rays = some_rays(module)
    if distance < 4:  # the cameras are outside
        put(module, lambda points: (points.norm(dim=-1) < edge) * 1e6)
    found = module.render(rays, torch.zeros(1, 3), None)
    origin = rays.origins - space.centre
    middle = (origin * rays.directions).sum(1)
    under = middle.square() - origin.square().sum(1) + distance**2
    hit = under > 0.1
    assert hit.sum() > 20
    expected = -middle + (1 if distance >= 4 else -1) * under.clamp_min(0).sqrt()
    # A sample is 4/2000 of pace long: in the world that times the square of distance over twice the radius, at least.
    longest = 2 * space.radius * 4 / 2000 * max(1.0, (expected[hit].max().item() / space.radius / 2) ** 2)
    assert (found.depth - expected)[hit].abs().max() < longest


def test_light_that_nothing_stops_comes_from_far(each):
    module = make(each)
    put(module, lambda points: torch.zeros(len(points)))
    out = module.render(some_rays(module), torch.full((1, 3), 0.5), None)
    assert out.depth.tolist() == [each.far] * 40
    assert (out.latent == 0.5).all()
    assert not out.opacity.any()


def test_gradients_reach_every_parameter(each):
    module = make(each)
    out = module.render(some_rays(module), torch.zeros(1, 3), Draws(0, 0))
    out.latent.square().sum().backward()
    for name, parameter in module.named_parameters():
        if not name.startswith("transform"):
            assert parameter.grad is not None, name
            assert parameter.grad.any(), name
    assert not out.depth.requires_grad
    assert not out.opacity.requires_grad


def test_samples_that_no_light_reaches_change_nothing(each):
    """Behind a wall, and without alpha: the gradient with them and without them."""
    found = []
    for every in (True, False):
        module = make(each, threshold=1e-5)
        with torch.no_grad():
            module.field.density.layers[-1].bias[0] = 4.0
        if every:
            module.field.lit = every_sample
        module.render(some_rays(module), torch.zeros(1, 3), None).latent.square().sum().backward()
        found.append(module.field.hash_grid.table.grad)
    assert (found[0] - found[1]).abs().max() < 1e-3 * found[0].abs().max()


# Free space


def with_ball(module: NGP) -> None:
    """In the density's place a ball of radius 0.8 round the world's origin."""

    def density(points: Tensor) -> Tensor:
        return math.exp(8) * (points.norm(dim=-1) < 0.8)

    put(module, density)
    module.field.log_density = lambda points: density(points).log()


def test_free_space_is_found(scene):
    module = make(scene, cells=20**3)
    with_ball(module)
    field, rays = module.field, some_rays(module)
    before = module.render(rays, torch.full((1, 3), 0.5), None)
    for step in range(20):
        field.update_occupancy(Draws(0, step), 1.0 if step == 0 else 0.25)
    vertices, half = field.grid.vertices(), 0.5 / field.grid.scale
    distance = vertices.norm(dim=1)
    reach = half.norm()
    assert field.occupancy[distance < 0.8 - reach].all()
    assert not field.occupancy[distance > 0.8 + reach].any()
    assert (field.around.abs() < 0.8 + 2 * reach).all()
    after = module.render(rays, torch.full((1, 3), 0.5), None)
    # Samples begin where the box round what is left begins: the ball's edge moves by less than a sample.
    assert (after.opacity - before.opacity).abs().mean() < 0.1
    assert after.opacity.max() > 0.99


def test_what_is_not_allowed_stays_free(scene):
    module = make(scene)
    with_ball(module)
    field = module.field
    field.allowed = field.grid.vertices()[:, 0] > 0
    field.update_occupancy(Draws(0, 0), 1.0)
    assert field.occupancy.any()
    assert not field.occupancy[~field.allowed].any()
    field.occupy(torch.zeros_like(field.occupancy))
    out = module.render(some_rays(module), torch.zeros(1, 3), None)
    assert not out.opacity.any()


def settling(scene: Scene) -> NGP:
    """With a ball, before as many looks as make cells free for good."""
    module = make(scene, cells=64**3, free_for_good=0.05)
    with_ball(module)
    return module


def test_free_space_round_an_object_settles(scene):
    module = settling(scene)
    assert module.settles
    module.field.update_occupancy(Draws(0, 0), 1.0)
    module.renew_pool()
    assert module.pool is None
    field = module.field
    field.settle(0.05, module.training_rays(torch.zeros(0, dtype=torch.long)), module.hull)
    distance, cell = field.grid.vertices().norm(dim=1), (1 / field.grid.scale).norm()
    assert field.allowed[distance < 0.8].all()
    assert not field.allowed[distance > 0.8 + 3 * cell].any()
    # It stays free whatever is found there later.
    module.field.log_density = lambda points: torch.full_like(points[:, 0], 5.0)
    field.update_occupancy(Draws(0, 1), 1.0)
    assert torch.equal(field.occupancy, field.allowed)
    # All rays are drawn that pass through what is left, and not all others.
    field.met &= distance < 0.3
    module.renew_pool()
    every = module.training_rays(torch.arange(len(module.pixels)))
    missed = (every.origins - (every.origins * every.directions).sum(1, keepdim=True) * every.directions).norm(dim=1)
    drawn = torch.zeros(len(missed), dtype=torch.bool)
    drawn[module.pool.long()] = True
    assert drawn[missed < 0.3 - float(cell)].all()
    assert 0.05 < drawn.float().mean() < 0.9


def test_what_the_field_has_lost_of_the_object_is_not_free_for_good(scene):
    module = make(scene, cells=24**3, free_for_good=0.05)
    with_ball(module)
    field, middle = module.field, module.field.grid.vertices()
    hull, half = module.hull(middle), 0.5 / field.grid.scale
    inside, there = middle.norm(dim=1) < 0.8, middle[:, 2] < 0.2
    assert hull[inside].all()
    assert 0.05 < hull.float().mean() < 0.5
    shown = module.shown_pixels()
    assert torch.equal(shown, (module.pixels[:, 3] > 0).nonzero().squeeze(1))
    field.alpha = (inside & there).float()
    field.occupy(field.alpha > 0)
    field.settle(0.05, module.training_rays(shown), module.hull)
    assert field.allowed[inside & there].all()
    # Above what is left, where views from the side look past it; not outside of the pictures' hull.
    above = middle[:, 2] > 0.2 + 3 * half[2]
    assert field.allowed[inside & (middle[:, 2] > 0.5)].float().mean() > 0.5
    assert hull[above & field.allowed].all()
    assert torch.equal(field.met[above], field.allowed[above])
    assert field.met[field.occupancy].all()
    field.update_occupancy(Draws(0, 0), 1.0)
    within = middle.norm(dim=1) < 0.8 - half.norm()
    assert torch.equal(field.occupancy[within], field.allowed[within])


def test_pixels_that_do_not_count_need_nothing(scene):
    mask = torch.rand(scene.train.images.shape[:3], generator=torch.Generator().manual_seed(0)) < 0.5
    module = make(dataclasses.replace(scene, train=dataclasses.replace(scene.train, mask=mask)))
    expected = mask.flatten() & (module.pixels[:, 3] > 0)
    assert torch.equal(module.shown_pixels(), expected.nonzero().squeeze(1))


@pytest.mark.parametrize("why", ["never", "behind", "alpha"])
def test_other_free_space_never_settles(scene, why):
    if why == "behind":
        scene = dataclasses.replace(scene, background="random")
    if why == "alpha":
        opaque = dataclasses.replace(scene.train, images=scene.train.images[..., :3].contiguous())
        scene = dataclasses.replace(scene, train=opaque)
    module = make(scene, free_for_good=0.0 if why == "never" else 0.05)
    assert not module.settles
    assert not make(dataclasses.replace(scene, geometry="unbounded"), free_for_good=0.05).settles


def test_pictures_are_made_with_the_mean_of_the_latest_parameters(scene):
    module = make(scene, averaged=8)
    module.average(module.total_steps - 8)
    assert module.train().shown("field") is module.field
    assert module.eval().shown("field") is module.mean_field
    points, directions = torch.rand(50, 3) - 0.5, torch.tensor([[0.0, 0.0, -1.0]]).repeat(50, 1)
    module.mean_field.occupancy[:], module.field.occupancy[:] = True, False
    assert (module.query(points, directions)[0] > 0).all()
    assert not module.train().query(points, directions)[0].any()
    trained = {id(parameter) for of in module.field_optimizers().values() for group in of.param_groups
               for parameter in group["params"]}  # fmt: skip
    assert trained == {id(parameter) for parameter in module.parameters() if parameter.requires_grad}


def test_occlusion_is_of_what_lies_close_before_the_cameras(scene):
    module = make(scene, occlusion=0.5)
    draws = module.draws(0)
    batch = module.draw(draws)
    rendering = module.predict(batch, draws)
    samples, space = rendering.samples, module.field.space
    s = (samples.t.double() - space.near) / (space.far - space.near)
    close = (samples.weights.double() * (1 - 2 * s).clamp_min(0) ** 2).sum() / len(batch.rgb)
    found = module.regularisers(batch, rendering, batch.rgb)
    assert found.keys() == {"occlusion"}
    assert close > 0
    assert found["occlusion"].item() == pytest.approx(0.5 * close.item(), rel=1e-4)
    assert not make(scene).regularisers(batch, rendering, batch.rgb)


# Settings


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"geometry": "round"}, "backbone.geometry: found 'round', expected one of bounded, forward, unbounded"),
        ({"finest": 8}, "backbone.finest: found 8, expected at least backbone.coarsest, 16"),
        ({"log2_entries": 30}, "backbone.log2_entries: found 30, expected an integer, 4 to 28"),
        ({"degrees": 0}, "backbone.degrees: found 0, expected an integer, 1 to 8"),
        ({"levels": 0}, "backbone.levels: found 0, expected a number >= 1"),
        ({"rays_per_pixel": 2}, "backbone.rays_per_pixel: found 2, expected a square number: 1, 4, 9, ..."),
        ({"rays_per_pixel": 0}, "backbone.rays_per_pixel: found 0, expected a square number: 1, 4, 9, ..."),
        ({"threshold": 1.0}, "backbone.threshold: found 1.0, expected a number in (0, 1)"),
        ({"free_for_good": 1.5}, "backbone.free_for_good: found 1.5, expected a number in [0, 1]"),
        ({"occupancy_share": 1.5}, "backbone.occupancy_share: found 1.5, expected a number in (0, 1]"),
        ({"lr_grid": math.nan}, "backbone.lr_grid: found nan, expected a number > 0"),
        ({"distortion": -1.0}, "backbone.distortion: found -1.0, expected a number >= 0"),
        ({"occlusion": -1.0}, "backbone.occlusion: found -1.0, expected a number >= 0"),
    ],
)
def test_settings_that_cannot_be_used(settings, message):
    with pytest.raises(ConfigError) as caught:
        NGPConfig(**settings)
    assert str(caught.value) == message


def test_geometry_of_another_scene(scene, forward):
    with pytest.raises(ConfigError, match=r"backbone\.geometry: found 'bounded', expected forward, as wall is"):
        NGP(NGPConfig(), forward)
    with pytest.raises(ConfigError, match=r"dataset\.near: found 0\.0, expected more than 0"):
        NGP(NGPConfig(geometry="unbounded"), dataclasses.replace(scene, geometry="unbounded", near=0.0))


# Runs


@pytest.mark.parametrize("ctm", ["off", "quick"])
def test_training_learns(compose, tmp_path, ctm):
    sizes = ("steps=150", "rays=128", "samples=64", "lr_grid=0.1")
    config = compose("backbone=ngp", f"ctm={ctm}", "ctm.pretrain_steps=100" if ctm == "quick" else "seed=0",
                     *(f"backbone.{size}" for size in sizes))  # fmt: skip
    result = train(config, tmp_path)
    assert result["converged"]
    assert result["psnr"] > result["constant_psnr"] + 3


@pytest.mark.parametrize("geometry", ["forward", "unbounded"])
def test_other_geometries_train(compose, tmp_path, monkeypatch, forward, geometry):
    scene = dataclasses.replace(forward, geometry=geometry)
    monkeypatch.setattr("ctm_plugin.runs.assemble.load_scene", lambda config: scene)
    result = train(compose("backbone=ngp", f"backbone.geometry={geometry}"), tmp_path)
    assert math.isfinite(result["psnr"])
