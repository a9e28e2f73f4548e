"""Where an appearance stands in a training step: between the rendering and the loss, and nowhere else."""

from dataclasses import replace

import pytest
import torch

from ctm_plugin.appearance.exposure import Exposure
from ctm_plugin.color.light import find_light
from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.compose.command_line import compose as composed_anew
from ctm_plugin.draws import Draws
from ctm_plugin.errors import ConfigError
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.train import warn_of_exposures
from ctm_plugin.settings.registry import APPEARANCES

SMALL = ("ctm=off", "backbone.coarse=false")


def stepped(parts):
    """What a training step of the whole gives, and its loss's gradients."""
    out = parts.backbone.training_step(None, 0)
    out["loss"].backward()
    return out


@pytest.mark.slow
@pytest.mark.parametrize("backbone", ["dvgo", "nerf", "ngp", "splat"])
def test_the_identity_changes_no_term(compose, backbone):
    """NeRF's coarse rendering too, DVGO's per-point error and the background."""
    small = SMALL if backbone == "dvgo" else SMALL[:1]
    terms = {}
    for chosen in (["none"], ["exposure", "appearance.start=same"]):
        name, *more = chosen
        parts = assemble(compose(f"backbone={backbone}", *small, f"appearance={name}", *more))
        stepped(parts)
        terms[name] = parts.backbone.terms
    assert terms["none"].keys() == terms["exposure"].keys()
    for name, term in terms["none"].items():
        torch.testing.assert_close(terms["exposure"][name], term, rtol=1e-4, atol=1e-7)


def test_points_are_compared_with_the_picture_undone(compose):
    """The per-point error is of samples, which no picture shows: its target is the field's colour, without gradient."""
    parts = assemble(compose(*SMALL, "appearance=exposure"))
    module = parts.backbone
    gains = torch.linspace(-1, 1, len(parts.scene.train))
    module.appearance.log_gain.data = gains
    draws = module.draws(0)
    batch = module.draw(draws)
    rendering = module.predict(batch, draws)
    terms, target, rgb = module.compare(batch, [rendering.latent], draws.uniform)
    view = batch.pixel // (12 * 12)
    expected = linear_to_srgb((srgb_to_linear(batch.rgb) / gains.exp()[view, None]).clamp(0, 1))
    torch.testing.assert_close(target, expected, atol=1e-5, rtol=1e-5)
    assert torch.equal(target, rgb)
    shown = linear_to_srgb((srgb_to_linear(rendering.latent) * gains.exp()[view, None]).clamp(0, 1))
    torch.testing.assert_close(terms["color"], (shown - batch.rgb).square().mean(), atol=1e-6, rtol=1e-4)
    point = module.regularisers(batch, rendering, target)["point"]
    assert torch.autograd.grad(point, module.appearance.log_gain, allow_unused=True)[0] is None


def test_backgrounds_are_what_each_picture_would_show(compose):
    """Else a white background that no camera took would hold all gains at 1."""
    parts = assemble(compose(*SMALL, "appearance=exposure", "dataset.background=white"))
    module = parts.backbone
    module.appearance.log_gain.data = torch.linspace(-1, 0, len(parts.scene.train))
    gains = module.appearance.log_gains().exp().detach()
    batch = module.draw(Draws(0, 0))
    clear = module.pixels[batch.pixel, 3] == 0
    assert clear.sum() > 10
    expected = linear_to_srgb(gains[batch.pixel // (12 * 12)].clamp(max=1))[:, None].expand(-1, 3)
    torch.testing.assert_close(batch.rgb[clear], expected[clear], atol=1e-5, rtol=0)


def test_where_pixels_lie(compose):
    module = assemble(compose(*SMALL, "appearance=exposure")).backbone
    place = module.place(torch.tensor([0, 11, 12 * 11, 12 * 12 * 3 + 12 + 2]), torch.zeros(4, 3))
    assert place.view.tolist() == [0, 0, 0, 3]
    expected = torch.tensor([[0.5, 0.5], [11.5, 0.5], [0.5, 11.5], [2.5, 1.5]]) / 12
    torch.testing.assert_close(place.at, expected)


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_its_light_is_that_of_pictures_of_one_exposure_without_noise(compose, noise):
    module = assemble(compose(*SMALL, "appearance=exposure")).backbone
    draws = torch.Generator().manual_seed(0)
    coarse = torch.rand(8, 3, 6, 7, generator=draws)
    lit = torch.nn.functional.interpolate(coarse, (384, 480), mode="bilinear").permute(0, 2, 3, 1)
    light = 0.02 * srgb_to_linear(0.1 + 0.8 * lit)
    gains = torch.linspace(-0.7, 0.7, 8)
    shown = light * gains.exp()[:, None, None, None] + noise * torch.randn(light.shape, generator=draws)
    train = replace(module.scene.train, images=linear_to_srgb(shown.clamp(0, 1)), mask=None, sizes=None)
    module.appearance.log_gain.data, module.scene = gains, replace(module.scene, train=train)
    found, expected = module.light, find_light(linear_to_srgb(light))
    assert found.gain == pytest.approx(expected.gain, rel=0.06)  # two of the steps that are tried
    assert found.contrast == pytest.approx(expected.contrast, abs=0.041)


def test_its_own_optimizer(compose):
    parts = assemble(compose(*SMALL, "appearance=exposure", "appearance.lr=0.02", "appearance.lr_decay=0.25"))
    optimizers = parts.backbone.configure_optimizers()
    optimizers.set_rates(parts.backbone.total_steps)
    groups = {group["name"]: group["lr"] for group in optimizers.members["appearance"].param_groups}
    assert groups == pytest.approx({"appearance/exposure": 0.005})
    for given in (["appearance=none"], ["appearance=exposure", "appearance.fixed=true"]):
        without = assemble(compose(*SMALL, *given)).backbone
        assert without.configure_optimizers().members.keys() == {"grids", "mlp"}


def test_another_package_s_kind(ball, monkeypatch):
    """Registered, chosen and set as one of ours."""

    class Tint(Exposure):
        pass

    monkeypatch.setitem(APPEARANCES.added, "tint", Tint)
    config = composed_anew(
        "dataset=blender", f"dataset.root={ball}", "trainer=smoke", *SMALL, "appearance=tint", "appearance.lr=0.5"
    )
    appearance = assemble(config).backbone.appearance
    assert isinstance(appearance, Tint)
    assert appearance.config.lr == 0.5


def test_what_cannot_be(compose):
    with pytest.raises(ConfigError, match=r"appearance: found 'exposure', expected none: backbone=barf2d has no pict"):
        assemble(compose("backbone=barf2d", "dataset=planar", "ctm=off", "appearance=exposure"))
    config = compose(*SMALL)
    with pytest.raises(ConfigError, match=r"appearance\.lr: found an unknown key, expected no settings"):
        assemble(config | {"appearance": {"name": "none", "lr": 1}})
    with pytest.raises(ConfigError, match=r"appearance\.start: found 'exif', expected pictures .* 8 of 8 have none"):
        assemble(compose(*SMALL, "appearance=exposure", "appearance.start=exif"))


def test_pictures_that_exif_tells_apart(compose, recwarn):
    """Said where nothing holds them apart, once they differ by more than a quarter of a stop."""
    for name, longest, told in (("none", 0.04, 1), ("none", 0.0105, 0), ("exposure", 0.04, 0)):
        parts = assemble(compose(*SMALL, f"appearance={name}"))
        exposures = torch.tensor([0.01, longest, torch.nan, *[0.01] * 5])
        parts.backbone.scene = parts.scene = replace(parts.scene, train=replace(parts.scene.train, exposures=exposures))
        warn_of_exposures(compose(*SMALL, f"appearance={name}"), parts)
        found = [str(each.message) for each in recwarn if "EXIF" in str(each.message)]
        assert len(found) == told
        assert all("took 4 times the light of others: appearance=exposure appearance.start=exif" in f for f in found)
        recwarn.clear()
