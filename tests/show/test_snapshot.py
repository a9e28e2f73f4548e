"""What is seen of a field while it trains, and that looking changes nothing."""

from dataclasses import dataclass, replace

import pytest
import torch
from faults import checkpoint, differing, scores
from torch import nn

from ctm_plugin.backbones.radiance import RadianceBackbone, RayRendering
from ctm_plugin.backbones.untouched import snapshot
from ctm_plugin.color.light import brighten
from ctm_plugin.metrics.image import psnr
from ctm_plugin.runs.assemble import Parts, assemble
from ctm_plugin.runs.train import train
from ctm_plugin.scene.views import composite
from ctm_plugin.settings.registry import BACKBONES
from ctm_plugin.show.snapshot import Snapshot

DVGO = (
    "backbone.coarse=true", "backbone.coarse_steps=4", "backbone.steps=8", "backbone.grow=[3,5]",
    "backbone.occupancy_first=2", "backbone.coarse_lr_grid=4", "backbone.lr_grid=4", "backbone.rays=64",
    "ctm.pretrain_steps=5",
)  # fmt: skip
PLANAR = ("backbone=barf2d", "dataset=planar", "dataset.height=40", "dataset.width=50", "dataset.patch=16")


@dataclass(frozen=True, kw_only=True)
class CarelessConfig:
    steps: int = 6


class Careless(RadianceBackbone):
    """Does all that a backbone should not: numbers from the global generator, statistics of batches, random gaps."""

    Config = CarelessConfig

    def __init__(self, config, scene, transform=None, photometric=None, seed=0):
        super().__init__(scene, 32, transform, photometric, seed)
        self.total_steps = config.steps
        torch.manual_seed(seed)
        self.net = nn.Sequential(nn.Linear(3, 8), nn.BatchNorm1d(8), nn.Dropout(0.5), nn.Linear(8, self.channels))

    def render(self, rays, background, draws):
        noise = 0.1 * torch.rand(len(rays.origins), 3)
        latent = self.net(rays.directions + noise).float().sigmoid()
        return RayRendering((latent,), opacity=torch.ones(len(latent)), depth=torch.full((len(latent),), 3.0))

    def field_optimizers(self):
        return {"net": torch.optim.Adam(self.net.parameters(), 0.01)}


@pytest.mark.parametrize(
    "settings", [DVGO, *(pytest.param(each, marks=pytest.mark.slow) for each in (
        ("backbone=nerf", "backbone.steps=8", "ctm.k=2"), PLANAR, None))],
    ids=["dvgo", "nerf", "barf2d", "another's"],
)  # fmt: skip
def test_training_is_the_same_bit_for_bit(compose, tmp_path, monkeypatch, settings):
    monkeypatch.setitem(BACKBONES.added, "careless", Careless)
    ends = []
    for every in ("1", "null"):
        config = compose(*(settings or ()), f"trainer.image_every={every}")
        if settings is None:
            config |= {"backbone": {"name": "careless"}}
        train(config, tmp_path / every)
        saved = checkpoint(tmp_path / every)
        ends.append({key: saved.get(key) for key in ("state_dict", "optimizer_states", "batches_seen", "dvgo")})
    assert list(differing(*ends)) == []
    if settings is not None:  # another's rendering is random in evaluation too
        assert scores(tmp_path / "1") == scores(tmp_path / "null")


def test_modes_and_random_states_stay(compose, monkeypatch):
    monkeypatch.setitem(BACKBONES.added, "careless", Careless)
    module = assemble(compose("ctm=off") | {"backbone": {"name": "careless"}}).backbone
    module.net[2].eval()
    modes = [part.training for part in module.modules()]
    assert set(modes) == {True, False}
    states = {name: value.clone() for name, value in module.state_dict().items()}
    before = torch.get_rng_state()
    snapshot(module, 0)
    assert [part.training for part in module.modules()] == modes
    assert torch.equal(torch.get_rng_state(), before)
    assert list(differing(dict(module.state_dict()), states)) == []


def parts(compose, *arguments: str) -> Parts:
    return assemble(compose(*arguments))


def names(seen: Snapshot) -> set[str]:
    return {name.split("/")[1] for name in seen.pictures}


@pytest.mark.parametrize("k", [1, 3, 5])
def test_a_view(compose, k):
    made = parts(compose, *DVGO, f"ctm.k={k}", "dataset.exposure=0.1")
    seen, views = snapshot(made.backbone, 0), made.scene.test
    assert names(seen) == {"render", "target", "error", "latent", "depth", "lit", "cube"}
    target = composite(views.images[0], made.backbone.constant_background())
    assert torch.equal(seen.pictures["test/target"], target)
    made.backbone.eval()
    view = made.backbone.render_view(views, 0)
    assert torch.equal(seen.pictures["test/render"], view["rgb"])
    assert torch.equal(seen.latents["latent/render"], view["latent"])
    assert seen.latents["latent/scene"].shape[-1] == k
    left, right = seen.pictures["test/lit"][:, :12], seen.pictures["test/lit"][:, -12:]
    light = made.backbone.light
    assert 5 < light.gain < 40
    assert torch.equal(left, light.apply(view["rgb"]))
    assert torch.equal(right, light.apply(target))
    assert seen.scores["psnr"] == float(psnr(view["rgb"][None], target[None]))
    brightened = float(psnr(brighten(view["rgb"], 10.0, "hard"), brighten(target, 10.0, "hard")))
    assert seen.scores["psnr_enhanced"] == pytest.approx(brightened)


def test_a_view_without_a_picture(compose):
    made = parts(compose, *DVGO, "dataset.exposure=0.1")
    module, count = made.backbone, len(made.scene.test)
    some = torch.arange(count) == 1
    module.scene = replace(made.scene, test=replace(made.scene.test, pictured=some))
    assert module.snapshots == [1]
    assert torch.equal(snapshot(module, 1).pictures["test/target"], module.target(1))
    module.scene = replace(made.scene, test=replace(made.scene.test, pictured=some & False))
    assert module.snapshots == [0]
    seen = snapshot(module, 0)
    assert names(seen) == {"render", "latent", "depth", "lit", "cube"}
    assert seen.pictures["test/lit"].shape == seen.pictures["test/render"].shape
    assert seen.scores == {}


def test_one_ray_a_pixel_does(compose, monkeypatch):
    module = parts(compose, *DVGO, "backbone.rays_per_pixel=4").backbone
    drawn, own = [], module.render

    def render(rays, background, draws):
        drawn.append(draws)
        return own(rays, background, draws)

    monkeypatch.setattr(module, "render", render)
    snapshot(module, 0)
    assert set(drawn) == {None}
    module.eval().render_view(module.scene.test, 0)
    assert set(drawn) > {None}


def test_large_views_are_thinned_out(compose, monkeypatch):
    monkeypatch.setattr("ctm_plugin.backbones.base.PREVIEW_WIDTH", 5)
    made = parts(compose, *DVGO)
    seen = snapshot(made.backbone, 0)
    made.backbone.eval()
    whole = made.backbone.render_view(made.scene.test, 0)["rgb"]
    assert seen.pictures["test/render"].shape == (4, 4, 3)
    torch.testing.assert_close(seen.pictures["test/render"], whole[::3, ::3])  # the very same pixels
    monkeypatch.setattr("ctm_plugin.backbones.base.PREVIEW_WIDTH", 128)
    made.backbone.batch_rays = 4  # of 144 pixels no more than 8 steps have rays
    assert snapshot(made.backbone, 0).pictures["test/render"].shape == (4, 4, 3)


def test_a_picture_under_alignment(compose, monkeypatch):
    monkeypatch.setattr("ctm_plugin.backbones.base.PREVIEW_WIDTH", 25)
    made = parts(compose, *PLANAR, "dataset.exposure=0.1")
    seen = snapshot(made.backbone, 0)
    assert names(seen) == {"render", "target", "error", "latent", "warps", "lit", "cube"}
    assert torch.equal(seen.pictures["test/target"], made.scene.image[::2, ::2])
    assert seen.pictures["test/render"].shape == (20, 25, 3)
    assert seen.latents["latent/render"].shape == (20, 25, 3)


def test_another_kind_shows_its_colours(compose):
    from callbacks.toy import Toy

    seen = snapshot(Toy(3), 0)
    assert seen.pictures.keys() == {"colors/cube"}
    assert seen.latents.keys() == {"latent/scene"}
    assert seen.scores == {}
