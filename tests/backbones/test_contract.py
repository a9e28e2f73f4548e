"""What all fields along rays do alike, in all geometries that they are for."""

import dataclasses
import math

import pytest
import torch

from ctm_plugin.backbones.dvgo import DVGO
from ctm_plugin.backbones.nerf import NeRF
from ctm_plugin.backbones.ngp import NGP
from ctm_plugin.backbones.radiance import RadianceBackbone
from ctm_plugin.backbones.settings import DVGOConfig, NeRFConfig, NGPConfig
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.draws import Draws
from ctm_plugin.errors import ConfigError
from ctm_plugin.runs.train import train
from ctm_plugin.scene.views import Scene

SMALL = {
    "dvgo": (DVGO, DVGOConfig, {"rays": 64, "coarse": False, "voxels": 4096, "planes": 8, "grow": (), "features": 4}),
    "nerf": (NeRF, NeRFConfig, {"rays": 32, "coarse_samples": 8, "fine_samples": 12, "width": 16, "depth": 3,
                                "skip": 2}),
    "ngp": (NGP, NGPConfig, {"rays": 32, "samples": 60, "levels": 3, "log2_entries": 10, "coarsest": 4, "finest": 16,
                             "width": 16, "degrees": 2, "cells": 512}),
}  # fmt: skip
EVERY = [
    (name, geometry) for name, (kind, *_) in SMALL.items() for geometry in ("bounded", "forward", "unbounded")
    if geometry in kind.geometries
]  # fmt: skip
OCCUPIED = [(name, geometry) for name, geometry in EVERY if name != "nerf"]


@pytest.fixture
def make(ball, wall):
    bounded = BlenderConfig(root=ball).load()
    scenes = {"forward": wall} | {of: dataclasses.replace(bounded, geometry=of) for of in ("bounded", "unbounded")}

    def made(name: str, geometry: str, scene: Scene | None = None, **settings) -> RadianceBackbone:
        kind, config, small = SMALL[name]
        return kind(config(geometry=geometry, **small | settings), scene or scenes[geometry])

    made.scenes = scenes
    return made


def some_rays(module: RadianceBackbone, count: int = 40):
    return module.training_rays(torch.randint(len(module.pixels), (count,), generator=torch.Generator().manual_seed(2)))


@pytest.mark.parametrize(("name", "geometry"), EVERY)
def test_gradients_reach_every_parameter(make, name, geometry):
    module = make(name, geometry)
    for field in (module.coarse, module.fine) if name == "nerf" else ():  # about half of space has some density
        field.density.weight.data.mul_(4)
        field.density.bias.data.fill_(0.2)
    out = module.render(some_rays(module), torch.zeros(1, 3), Draws(0, 0))
    sum(latent.square().sum() for latent in out.latents).backward()
    for key, parameter in module.named_parameters():
        if not key.startswith("transform"):
            assert parameter.grad is not None, key
            assert parameter.grad.any(), key
    assert all(((latent >= 0) & (latent <= 1)).all() for latent in out.latents)
    assert not out.depth.requires_grad
    assert not out.opacity.requires_grad
    trained = {id(parameter) for of in module.field_optimizers().values() for group in of.param_groups
               for parameter in group["params"]}  # fmt: skip
    assert trained == {id(parameter) for parameter in module.parameters() if parameter.requires_grad}


@pytest.mark.parametrize(("name", "geometry"), EVERY)
def test_what_nothing_fills(make, name, geometry):
    module = make(name, geometry)
    for key, value in module.named_parameters():
        if "density" in key:
            value.data.fill_(0.0 if "weight" in key else -100.0)
    out = module.render(some_rays(module), torch.full((1, 3), 0.5), None)
    assert out.depth.tolist() == [module.scene.far] * 40
    assert (out.latent == 0.5).all()
    assert not out.opacity.any()


@pytest.mark.parametrize("name", ["nerf", "ngp"])
def test_geometry_of_another_scene(make, name):
    with pytest.raises(ConfigError, match=r"backbone\.geometry: found 'bounded', expected forward, as wall is"):
        make(name, "bounded", make.scenes["forward"])
    with pytest.raises(ConfigError, match=r"backbone\.geometry: found 'unbounded', expected bounded, as ball is"):
        make(name, "unbounded", make.scenes["bounded"])
    with pytest.raises(ConfigError, match=r"dataset\.near: found 0\.0, expected more than 0"):
        make(name, "unbounded", dataclasses.replace(make.scenes["unbounded"], near=0.0))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "geometry"), [each for each in EVERY if each[1] != "bounded" and each[0] != "dvgo"])
def test_other_geometries_train(compose, tmp_path, monkeypatch, wall, name, geometry):
    scene = dataclasses.replace(wall, geometry=geometry)
    monkeypatch.setattr("ctm_plugin.runs.assemble.load_scene", lambda *_: scene)
    result = train(compose(f"backbone={name}", f"backbone.geometry={geometry}"), tmp_path)
    assert math.isfinite(result["psnr"])


@pytest.mark.parametrize(("name", "geometry"), OCCUPIED)
def test_losses_of_where_weights_lie(make, name, geometry):
    """Distances as shares of the way from near to far of the space."""
    module = make(name, geometry, distortion=0.5, occlusion=0.25)
    draws = module.draws(0)
    batch = module.draw(draws)
    rendering = module.predict(batch, draws)
    found = module.regularisers(batch, rendering, batch.rgb)
    samples, space = rendering.samples, module.field.space
    weights, interval = samples.weights.double(), space.stride / (space.far - space.near)
    s = (samples.t.double() - space.near) / (space.far - space.near)
    same = samples.ray_index[:, None] == samples.ray_index
    apart = (weights[:, None] * weights * (s[:, None] - s).abs())[same].sum() + weights.square().sum() * interval / 3
    close = (weights * (1 - 2 * s).clamp_min(0) ** 2).sum()
    assert 0 <= s.min() < s.max() <= 1
    assert found["distortion"].item() == pytest.approx(0.5 * apart.item() / len(batch.rgb), rel=1e-4)
    assert found["occlusion"].item() == pytest.approx(0.25 * close.item() / len(batch.rgb), rel=1e-4)
    without = make(name, geometry, distortion=0.0, occlusion=0.0)
    assert not {"distortion", "occlusion"} & without.regularisers(batch, rendering, batch.rgb).keys()
    if geometry == "bounded" and name == "dvgo":  # the coarse stage has neither
        module.stage = "coarse"
        assert not {"distortion", "occlusion"} & module.regularisers(batch, rendering, batch.rgb).keys()


@pytest.mark.parametrize(("name", "geometry"), OCCUPIED)
def test_pictures_are_made_with_the_mean_of_the_latest_parameters(make, name, geometry):
    """Only in evaluation, and only of the size that the field has in the end."""
    steps = {"steps_alone": 40, "grow": (8,)} if name == "dvgo" else {"steps": 40}
    module = make(name, geometry, averaged=4, **steps)
    for step in range(0, 12, 2):
        module.average(step)
        assert (module.mean_field is None) == (step < 8)
    module.mean_field.occupancy[:] = False
    batch = module.draw(module.draws(0))
    assert module.predict(batch, module.draws(0)).opacity.any()
    assert not module.eval().render_rays(batch.rays).opacity.any()
    rays = some_rays(module)
    points = rays.origins + 0.5 * (module.scene.near + module.scene.far) * rays.directions
    assert not module.query(points, rays.directions)[0].any()
    assert module.train().query(points, rays.directions)[0].any()
