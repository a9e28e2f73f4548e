"""NeRF: its rendering against a loop in float64, what it draws, the geometries, whole runs."""

import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from ctm_plugin import cli
from ctm_plugin.backbones.nerf import NeRF
from ctm_plugin.backbones.settings import NeRFConfig
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.draws import Draws
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.runs.rundir import METRICS
from ctm_plugin.runs.train import train
from ctm_plugin.scene.views import Scene

SMALL = {"coarse_samples": 8, "fine_samples": 12, "width": 16, "depth": 3, "skip": 2, "rays": 32}


@pytest.fixture(scope="module")
def scene(ball) -> Scene:
    return BlenderConfig(root=ball).load()


def make(scene: Scene, **settings) -> NeRF:
    return NeRF(NeRFConfig(geometry=scene.geometry, **SMALL | settings), scene)


def some_rays(module: NeRF, count: int = 40) -> Rays:
    return module.training_rays(torch.randint(len(module.pixels), (count,), generator=torch.Generator().manual_seed(2)))


def with_density(module: NeRF) -> NeRF:
    """About half of space has some."""
    with torch.no_grad():
        for field in (module.coarse, module.fine):
            field.density.weight.mul_(4)
            field.density.bias.fill_(0.2)
    return module


class Fog(torch.nn.Module):
    """A network's place taken by a density and a latent at each point."""

    def __init__(self, density, latent=lambda points: torch.sigmoid(points)):
        super().__init__()
        self.density, self.latent, self.seen = density, latent, []

    def forward(self, points: Tensor, directions: Tensor, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        self.seen.append((points, directions, noise))
        return self.density(points), self.latent(points)


def slow(t: Tensor, density: Tensor, latent: Tensor, background: Tensor, far: float, length: float) -> tuple:
    """One ray, sample after sample."""
    light, color, depth = 1.0, torch.zeros(latent.shape[-1], dtype=torch.float64), 0.0
    for index in range(len(t)):
        gap = (t[index + 1] - t[index]).item() * length if index + 1 < len(t) else 1e10
        alpha = 1 - math.exp(-density[index].item() * gap)
        color += light * alpha * latent[index].double()
        depth += light * alpha * t[index].item()
        light *= 1 - alpha
    return color + light * background.double(), depth + light * far, 1 - light


def test_rendering(scene):
    module = make(scene)
    module.fine = Fog(lambda points: (points.norm(dim=-1) < 1) * 3.0)
    rays, background = some_rays(module), torch.rand(40, 3)
    found = module.render(rays, background, None)
    points = module.fine.seen[0][0]
    t = (points - rays.origins[:, None]).norm(dim=-1)
    assert t.shape == (40, 20)
    for index in range(40):
        args = t[index], module.fine.density(points)[index], module.fine.latent(points)[index], background[index]
        color, depth, opacity = slow(*args, scene.far, 1.0)
        torch.testing.assert_close(found.latent[index].double(), color, atol=1e-5, rtol=0)
        assert found.depth[index].item() == pytest.approx(depth, abs=1e-4)
        assert found.opacity[index].item() == pytest.approx(opacity, abs=1e-5)
    assert 0 < (found.opacity > 0.9).float().mean() < 1


def test_both_networks_take_the_loss_the_fine_one_last(scene):
    module = make(scene)
    module.coarse = Fog(lambda points: torch.ones_like(points[..., 0]), lambda points: torch.full_like(points, 0.25))
    module.fine = Fog(lambda points: torch.ones_like(points[..., 0]), lambda points: torch.full_like(points, 0.75))
    out = module.render(some_rays(module), torch.zeros(1, 3), None)
    assert [latent.mean().item() for latent in out.latents] == pytest.approx([0.25, 0.75])
    assert out.latent is out.latents[1]


def test_directions_are_the_worlds(wall):
    module = make(wall)
    module.coarse = Fog(lambda points: torch.ones_like(points[..., 0]))
    rays = some_rays(module)
    module.render(rays, torch.zeros(1, 3), None)
    assert torch.equal(module.coarse.seen[0][1], rays.directions)


def test_samples_gather_where_the_coarse_network_found_something(scene):
    module = make(scene, coarse_samples=32, fine_samples=64)
    module.coarse = Fog(lambda points: (points[..., 2].abs() < 0.3) * 50.0)
    module.fine = Fog(module.coarse.density)
    rays = Rays(torch.tensor([[0.0, 0.0, 4.0]]), torch.tensor([[0.0, 0.0, -1.0]]))
    module.render(rays, torch.zeros(1, 3), None)
    z = module.fine.seen[0][0][0, :, 2]
    assert len(z) == 96
    assert (z.diff() <= 0).all()
    # Light is stopped by the first samples within: spaced 1/8, with half of that to the middles between them.
    assert ((z > 0.05) & (z < 0.45)).sum() > 60
    coarse = module.coarse.seen[0][0][0, :, 2]
    torch.testing.assert_close(coarse, 4 - (2 + (torch.arange(32) + 0.5) / 8))


@pytest.mark.parametrize("geometry", ["bounded", "unbounded"])
def test_samples_of_both_spacings(scene, geometry):
    module = make(dataclasses.replace(scene, geometry=geometry), coarse_samples=16)
    module.coarse = Fog(lambda points: torch.zeros_like(points[..., 0]))
    rays = some_rays(module)
    module.render(rays, torch.zeros(1, 3), None)
    s = (torch.arange(16) + 0.5) / 16
    expected = 2 + 4 * s if geometry == "bounded" else 1 / ((1 - s) / 2 + s / 6)
    t = (module.coarse.seen[0][0] - rays.origins[:, None]).norm(dim=-1)
    torch.testing.assert_close(t, expected.expand(40, 16), atol=1e-5, rtol=0)


@pytest.mark.parametrize("depth", [1.5, 3.0, 10.0])
def test_depths_of_forward_facing_scenes_are_distances(wall, depth):
    """A wall across the view, between samples in NDC."""
    module = make(wall, coarse_samples=64, fine_samples=256)
    front = 1 - 2 * wall.near / depth  # z in NDC
    module.coarse = module.fine = Fog(lambda points: (points[..., 2] > front) * 1e4)
    rays = some_rays(module)
    out = module.render(rays, torch.zeros(1, 3), None)
    expected = (-depth - rays.origins[:, 2]) / rays.directions[:, 2]
    # Depth is near / (1 - t), of samples that are 1/64 apart in t until the fine ones come.
    torch.testing.assert_close(out.depth, expected, atol=0, rtol=depth / wall.near / 64)
    torch.testing.assert_close(out.opacity, torch.ones(40))


def test_the_last_sample_stands_for_all_behind_it(wall):
    module = make(wall)
    module.coarse = module.fine = Fog(lambda points: torch.full_like(points[..., 0], 1e-6))
    out = module.render(some_rays(module), torch.zeros(1, 3), None)
    torch.testing.assert_close(out.opacity, torch.ones(40))
    torch.testing.assert_close(out.depth, torch.full((40,), wall.far), rtol=0.2, atol=0)


# Random numbers


def test_noise_only_in_training(scene):
    module = make(scene, density_noise=1.5)
    module.coarse = module.fine = Fog(lambda points: torch.ones_like(points[..., 0]))
    module.render(some_rays(module), torch.zeros(1, 3), None)
    assert all(noise is None for _, _, noise in module.fine.seen)
    module.fine.seen.clear()
    module.render(some_rays(module, 3000), torch.zeros(1, 3), Draws(0, 0))
    for _, _, noise in module.fine.seen:
        assert noise.std().item() == pytest.approx(1.5, rel=0.03)
        assert noise.mean().item() == pytest.approx(0, abs=0.03)
    module = make(scene)
    module.coarse = module.fine = Fog(lambda points: torch.ones_like(points[..., 0]))
    module.render(some_rays(module), torch.zeros(1, 3), Draws(0, 0))
    assert all(noise is None for _, _, noise in module.fine.seen)


def test_samples_of_training_are_random_one_in_each_part(scene):
    module = make(scene)
    module.coarse = Fog(lambda points: torch.zeros_like(points[..., 0]))
    rays = some_rays(module, 400)
    module.render(rays, torch.zeros(1, 3), Draws(0, 0))
    module.render(rays, torch.zeros(1, 3), Draws(0, 1))
    first, second = ((points - rays.origins[:, None]).norm(dim=-1) for points, _, _ in module.coarse.seen)
    for t in (first, second):
        assert torch.equal(((t - 2) / 4 * 8 + 1e-5).floor().clamp_max(7), torch.arange(8.0).expand(400, 8))
    assert (first - second).abs().mean() > 0.1


def test_evaluation_in_chunks(scene):
    """In float64: products of other sizes add up in another order, and fine samples lie where they say."""
    torch.set_default_dtype(torch.float64)
    try:
        module = with_density(make(scene)).double()
        rays = some_rays(module, 100)
        whole = module.render_rays(rays)
        module.eval_chunk = 7
        parts = module.render_rays(rays)
        for name in ("latent", "opacity", "depth"):
            torch.testing.assert_close(getattr(parts, name), getattr(whole, name), atol=1e-6, rtol=1e-6)
        assert torch.equal(module.render_rays(rays).latent, parts.latent)
    finally:
        torch.set_default_dtype(torch.float32)


def test_middle_pixels(scene):
    module = make(scene)
    pixel = module.middle_pixels().long()
    assert len(pixel.unique()) == len(pixel) == 8 * 6 * 6  # of 12 x 12
    assert ((pixel // 12 % 12).unique().tolist(), (pixel % 12).unique().tolist()) == ([*range(3, 9)], [*range(3, 9)])
    assert (pixel // 144).unique().tolist() == list(range(8))


def test_first_steps_draw_from_the_middle(compose, tmp_path, monkeypatch):
    drawn = {}
    rays = NeRF.training_rays

    def training_rays(self, pixel):
        drawn[self.batches_seen - 1] = pixel
        return rays(self, pixel)

    monkeypatch.setattr(NeRF, "training_rays", training_rays)
    train(compose("backbone=nerf", "ctm=off", "backbone.steps=9", "backbone.crop_steps=4"), tmp_path)
    inside = [bool(((pixel // 12 % 12 // 3 % 3 > 0) & (pixel % 12 // 3 % 3 > 0)).all()) for pixel in drawn.values()]
    assert inside == [True] * 4 + [False] * 5


# Runs


@pytest.mark.parametrize("ctm", ["off", "on", "quick"])
def test_the_command(ball, tmp_path, monkeypatch, ctm):
    monkeypatch.chdir(tmp_path)
    arguments = ["+backbone=nerf", f"+ctm={ctm}", "trainer=smoke", "dataset=blender", f"dataset.root={ball}"]
    assert cli.main([*arguments, "hydra.run.dir=run", *(["ctm.pretrain_steps=5"] if ctm == "quick" else [])]) == 0
    found = json.loads(Path("run", METRICS).read_text())
    assert (found["backbone"], found["steps"]) == ("nerf", 20)
    assert math.isfinite(found["psnr"])


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_training_learns(compose, tmp_path, precision):
    sizes = ("steps=150", "rays=128", "width=32", "lr=0.005", "coarse_samples=16", "fine_samples=16")
    settings = (f"trainer.precision={precision}", *(f"backbone.{size}" for size in sizes))
    result = train(compose("backbone=nerf", "ctm=off", *settings), tmp_path)
    assert result["converged"]
    assert result["psnr"] > result["constant_psnr"] + 3
