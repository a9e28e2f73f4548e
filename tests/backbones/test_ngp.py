"""NGP: its networks in float64 in three geometries, free space, settings, whole runs."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from ctm_plugin.backbones.ngp import NGP
from ctm_plugin.backbones.settings import NGPConfig
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.draws import Draws
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.spherical_harmonics import harmonics
from ctm_plugin.runs.train import train
from ctm_plugin.scene.kinds import GEOMETRIES
from ctm_plugin.scene.views import Scene

SMALL = {
    "rays": 32, "samples": 60, "levels": 3, "log2_entries": 10, "coarsest": 4, "finest": 16, "width": 16, "degrees": 2,
    "cells": 512,
}  # fmt: skip


@pytest.fixture(scope="module")
def scene(ball) -> Scene:
    return BlenderConfig(root=ball).load()


@pytest.fixture(params=GEOMETRIES)
def each(request, scene, wall) -> Scene:
    return wall if request.param == "forward" else dataclasses.replace(scene, geometry=request.param)


def make(scene: Scene, **settings) -> NGP:
    return NGP(NGPConfig(geometry=scene.geometry, **SMALL | settings), scene)


def some_rays(module: NGP, count: int = 40) -> Rays:
    return module.training_rays(torch.randint(len(module.pixels), (count,), generator=torch.Generator().manual_seed(2)))


def with_ball(module: NGP) -> None:
    """In the density's place a ball of radius 0.8 round the world's origin, of the depth network's place colours."""

    def density(points: Tensor) -> Tensor:
        return math.exp(8) * (points.norm(dim=-1) < 0.8)

    field = module.field
    field.reached = lambda t, ray_index, points, n_rays: (t, ray_index, points)
    field.evaluate = lambda points: (density(points), lambda index, directions, ray: points[index].sigmoid())
    field.log_density = lambda points: density(points).log()


def test_evaluation(each):
    """Both networks and the harmonics on the hash grid's features, in float64."""
    module = make(each)
    field = module.field
    torch.nn.init.uniform_(field.hash_grid.table, -1, 1)
    _, ray, points = field.samples(field.space.local(rays := some_rays(module)), 0.5)
    density, shade = field.evaluate(points)
    unit = (points - field.space.aabb[0]) / field.space.aabb.diff(dim=0).max()
    out = field.hash_grid(unit).double()
    for layer in (first := field.density.layers)[0], first[2]:
        out = (out if layer is first[0] else out.relu()) @ layer.weight.double().T + layer.bias.double()
    torch.testing.assert_close(density.double(), out[:, 0].clamp_max(15).exp(), atol=1e-5, rtol=1e-4)
    hidden = torch.cat([out, harmonics(rays.directions, 2).double()[ray]], dim=1)
    for layer in field.color.layers[::2]:
        hidden = (hidden if layer is field.color.layers[0] else hidden.relu()) @ layer.weight.double().T
        hidden = hidden + layer.bias.double()
    every = torch.arange(len(points))
    torch.testing.assert_close(shade(every, rays.directions, ray).double(), hidden.sigmoid(), atol=1e-5, rtol=0)


def test_samples_that_no_light_reaches_change_nothing(each):
    """Behind a wall, and without alpha: the gradient with them and without them."""
    found = []
    for every in (True, False):
        module = make(each, threshold=1e-5)
        with torch.no_grad():
            module.field.density.layers[-1].bias[0] = 4.0
        if every:
            module.field.reached = lambda t, ray_index, points, n_rays: (t, ray_index, points)
        module.render(some_rays(module), torch.zeros(1, 3), None).latent.square().sum().backward()
        found.append(module.field.hash_grid.table.grad)
    assert (found[0] - found[1]).abs().max() < 1e-3 * found[0].abs().max()


# Free space


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
    field.free_permanently(0.05, module.training_rays(torch.zeros(0, dtype=torch.long)), module.hull)
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
    field.free_permanently(0.05, module.training_rays(shown), module.hull)
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


# Runs


@pytest.mark.slow
@pytest.mark.parametrize("ctm", ["off", "quick"])
def test_training_learns(compose, tmp_path, ctm):
    sizes = ("steps=150", "rays=128", "samples=64", "lr_grid=0.1")
    config = compose("backbone=ngp", f"ctm={ctm}", "ctm.pretrain_steps=100" if ctm == "quick" else "seed=0",
                     *(f"backbone.{size}" for size in sizes))  # fmt: skip
    result = train(config, tmp_path)
    assert result["converged"]
    assert result["psnr"] > result["constant_psnr"] + 3
