"""DVGO's two stages, and what happens where its grid grows."""

import math
from dataclasses import replace

import pytest
import torch

from ctm_plugin.backbones.dvgo import DVGO
from ctm_plugin.color.spaces.rgb import Space as RGB
from ctm_plugin.rays.grid import add_smoothing
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.rundir import LAST
from ctm_plugin.runs.train import train
from ctm_plugin.scene.frustum import view_counts


@pytest.mark.parametrize(
    ("decay", "coarse", "fine", "of_coarse", "of_fine"),
    [
        ("null", 100, 300, 300, 300),
        ("null", 900, 300, 900, 300),
        ("50", 900, 300, 50, 50),
    ],
)
def test_rates_fall_to_a_tenth(compose, decay, coarse, fine, of_coarse, of_fine):
    settings = (f"lr_decay_steps={decay}", f"coarse_steps={coarse}", f"steps={fine}", "coarse=true")
    dvgo = assemble(compose("backbone=dvgo", *(f"backbone.{each}" for each in settings))).backbone
    for stage, start, length in (("coarse", 0, of_coarse), ("fine", coarse, of_fine)):
        dvgo.stage = stage
        schedule = dvgo.field_schedule()
        assert schedule(start) == 1
        assert schedule(start + length) == pytest.approx(0.1)
        assert schedule(start + length // 2) == pytest.approx(0.1**0.5)


@pytest.mark.parametrize(("coarse", "final"), [("true", 0.2), ("false", 0.3)])
def test_rates_fall_to_what_they_are_asked_to(compose, coarse, final):
    settings = (
        f"coarse={coarse}",
        "coarse_steps=10",
        "steps=60",
        "steps_alone=60",
        "lr_final=0.2",
        "lr_final_alone=0.3",
    )
    dvgo = assemble(compose(*(f"backbone.{each}" for each in settings), "backbone.lr_decay_steps=60")).backbone
    dvgo.stage = "fine"
    assert dvgo.field_schedule()(dvgo.fine_start + 60) == pytest.approx(final)


@pytest.mark.parametrize(("geometry", "steps", "factor"), [("bounded", 20000, 0.158), ("forward", 30000, 0.079)])
def test_rates_of_the_paper_start_again_at_each_growth(compose, hall, geometry, steps, factor):
    """DVGO makes its Adam anew where the grid grows: a factor counts from the last growth."""
    data = ["dataset=llff", f"dataset.root={hall}"] if geometry == "forward" else []
    dvgo = assemble(compose(*data, "trainer=paper", "backbone.voxels=8000", "backbone.planes=8")).backbone
    dvgo.stage, dvgo.fine_start = "fine", 0
    for grown, start in enumerate([0, *dvgo.config.grow]):
        dvgo.grown = grown
        assert dvgo.field_schedule()(start) == 1
    assert dvgo.field_schedule()(steps) == pytest.approx(factor, abs=1e-3)


class Shrinking(RGB):
    """Latents with a hundredth of the colours' differences."""

    def encode(self, rgb: torch.Tensor) -> torch.Tensor:
        return 0.5 + 0.01 * rgb


GROWING = ("backbone.coarse=false", "backbone.steps_alone=6", "backbone.grow=[2,4]", "trainer.image_every=null")


@pytest.fixture
def grown(compose, tmp_path, monkeypatch):
    """``grown(*more)``: the field's shift before and after six steps that grow twice, the steps that Adam counts, the
    rates at the end, and the checkpoint.
    """

    def run(*more: str):
        config, seen = compose(*GROWING, *more), {}
        fit_end = DVGO.on_fit_end

        def on_fit_end(self):
            members = self.named_optimizers.members
            seen["steps"] = {state["step"] for name in ("grids", "mlp") for state in members[name].state.values()}
            seen["rates"] = [group["lr"] / group["initial_lr"] for group in members["grids"].param_groups]
            seen["shift"] = self.field.vertex_shift
            fit_end(self)

        monkeypatch.setattr(DVGO, "on_fit_end", on_fit_end)
        train(config, tmp_path / "run")
        seen["fresh"] = assemble(config).backbone
        seen["before"] = seen["fresh"].field.vertex_shift
        seen["saved"] = torch.load(tmp_path / "run" / LAST, weights_only=True)
        return seen

    return run


def test_growing_as_dvgo_does(grown):
    """Adam begins anew, rates where they were at first, and each growth takes 1 off the shift, in checkpoints too."""
    seen = grown("backbone.restart=true", "backbone.shift_drop=1.0", "backbone.lr_decay_steps=10")
    assert {int(step) for step in seen["steps"]} == {2}
    assert seen["rates"] == pytest.approx([0.1 ** (2 / 10)] * 2)
    assert seen["shift"] == pytest.approx(seen["before"] - 2)
    seen["fresh"].on_load_checkpoint(seen["saved"])
    assert seen["fresh"].field.vertex_shift == pytest.approx(seen["before"] - 2)


def test_growing_without_a_break(grown):
    seen = grown("backbone.restart=false", "backbone.shift_drop=0", "backbone.lr_decay_steps=10")
    assert {int(step) for step in seen["steps"]} == {6}
    assert seen["rates"] == pytest.approx([0.1 ** (6 / 10)] * 2)
    assert seen["shift"] == seen["before"]
    seen["fresh"].on_load_checkpoint(seen["saved"])
    assert seen["fresh"].field.vertex_shift == seen["before"]


@pytest.mark.parametrize("least", [0, 3, 8, 100])
def test_voxels_that_few_views_see_are_free(compose, least):
    dvgo = assemble(compose("backbone.coarse=true", "backbone.grow=[]")).backbone
    dvgo.coarse_views = least
    seen, _ = view_counts(dvgo.field.grid.vertices(), dvgo.scene.train, dvgo.scene.near)
    assert seen.min() < 3 < seen.max() == len(dvgo.scene.train) == 8
    dvgo.free_what_floats()
    # More views than there are would leave nothing.
    torch.testing.assert_close(dvgo.field.occupancy, seen >= min(least, 8))


@pytest.mark.parametrize("exposure", [1.0, 0.05])
def test_losses_relative_to_the_variance_of_the_colours(compose, exposure):
    settings = (f"dataset.exposure={exposure}", "ctm=off", "loss.weight=3", "backbone.relative=true")
    dvgo = assemble(compose("dataset=white_room", "dataset.light=lit", *settings)).backbone
    dvgo.on_train_start()
    # Colours are drawn: 2^15 of them.
    variance = dvgo.scene.train.images.double().div(255).flatten(0, 2).var(0).mean().item()
    assert dvgo.photometric.weight == pytest.approx(3 / 12 / variance, rel=0.05)
    saved = {"state_dict": dvgo.state_dict()}
    dvgo.on_save_checkpoint(saved)
    again = assemble(compose("dataset=white_room", "dataset.light=lit", *settings)).backbone
    again.on_load_checkpoint(saved)
    again.on_load_checkpoint(saved)  # once is enough
    assert again.photometric.weight == pytest.approx(dvgo.photometric.weight)
    saved["dvgo"]["loss_scale"] = math.nan
    with pytest.raises(ValueError, match="a loss of nan times"):
        again.on_load_checkpoint(saved)


def test_what_an_untrained_transform_shrinks_is_not_made_up_for(compose):
    dvgo = assemble(compose("dataset=white_room", "dataset.light=lit", "backbone.relative=true")).backbone
    dvgo.transform = Shrinking()
    dvgo.on_train_start()
    variance = dvgo.scene.train.images.double().div(255).flatten(0, 2).var(0).mean().item()
    assert dvgo.photometric.weight == pytest.approx(1 / 12 / variance, rel=0.05)


def test_a_scene_of_one_colour_has_a_finite_loss(compose):
    dvgo = assemble(
        compose("dataset=white_room", "dataset.exposure=1e-6", "ctm=off", "backbone.relative=true")
    ).backbone
    assert not dvgo.pixels.any()
    dvgo.on_train_start()
    assert 0 < dvgo.photometric.weight < 1e6


@pytest.mark.parametrize("geometry", ["bounded", "forward"])
def test_distortion_is_of_the_share_of_the_way_from_near_to_far(compose, hall, geometry):
    data = ["dataset=llff", f"dataset.root={hall}"] if geometry == "forward" else ["backbone.coarse=false"]
    dvgo = assemble(compose(*data, "backbone.distortion=0.5", "backbone.voxels=4096", "backbone.planes=8")).backbone
    draws = dvgo.draws(0)
    batch = dvgo.draw(draws)
    rendering = dvgo.predict(batch, draws)
    found = dvgo.regularisers(batch, rendering, batch.rgb)["distortion"]
    samples, field = rendering.samples, dvgo.field
    weights, interval = samples.weights.double(), field.stride / (field.far - field.near)
    s = (samples.t.double() - field.near) / (field.far - field.near)
    same = samples.ray_index[:, None] == samples.ray_index
    apart = (weights[:, None] * weights * (s[:, None] - s).abs())[same].sum() + weights.square().sum() * interval / 3
    assert 0 <= s.min() < s.max() <= 1
    assert found.item() == pytest.approx(0.5 * apart.item() / len(batch.rgb), rel=1e-4)


def test_coarse_stage_is_for_lit_scenes_before_nothing(compose):
    dvgo = assemble(compose("backbone.coarse=auto")).backbone
    assert dvgo.wants_coarse()
    train = dvgo.scene.train
    dvgo.scene = replace(dvgo.scene, train=replace(train, images=train.images[..., :3].contiguous()))
    assert not dvgo.wants_coarse()
    assert not assemble(compose("backbone.coarse=auto", "dataset.exposure=0.02")).backbone.wants_coarse()


def test_occlusion_is_of_the_fine_stage_alone(compose):
    dvgo = assemble(compose("backbone.coarse=true", "backbone.occlusion=0.5", "backbone.coarse_voxels=4096")).backbone
    draws = dvgo.draws(0)
    batch = dvgo.draw(draws)
    rendering = dvgo.predict(batch, draws)
    assert "occlusion" not in dvgo.regularisers(batch, rendering, batch.rgb)
    dvgo.stage, samples, field = "fine", rendering.samples, dvgo.field
    s = (samples.t.double() - field.near) / (field.far - field.near)
    close = (samples.weights.double() * (1 - 2 * s).clamp_min(0) ** 2).sum() / len(batch.rgb)
    assert close > 0
    found = dvgo.regularisers(batch, rendering, batch.rgb)["occlusion"]
    assert found.item() == pytest.approx(0.5 * close.item(), rel=1e-4)


@pytest.mark.parametrize(("step", "dense"), [(0, True), (1, None), (3, False), (4, None)])
def test_total_variation_takes_turns(compose, monkeypatch, step, dense):
    """Of three steps one smooths, three times as much; later on where rays went alone."""
    tv = ("tv_density=0.01", "tv_every=3", "tv_dense_steps=2", "voxels=512", "grow=[]", "coarse=false", "rays=64")
    dvgo = assemble(compose("trainer=paper", *(f"backbone.{each}" for each in tv))).backbone
    monkeypatch.setattr(DVGO, "global_step", step)
    table, shape = dvgo.field.density, dvgo.field.grid.shape
    torch.nn.init.uniform_(table)
    table.grad = torch.zeros_like(table)
    table.grad[::2] = 1e-3
    expected = table.grad.clone()
    if dense is not None:
        weights = (3 * 0.01 / 64 / 6 / 128 * max(shape),) * 3
        other = torch.nn.Parameter(table.detach().clone())
        other.grad = expected
        add_smoothing(other, shape, weights, seen_only=not dense)
    dvgo.on_before_optimizer_step(torch.optim.SGD([table]))
    torch.testing.assert_close(table.grad, expected)
    assert dvgo.smooths == (dense is not None)
    assert (dvgo.field.features.grad is None) or not dvgo.field.features.grad.any()


def test_pictures_are_made_with_the_mean_of_grid_and_network(compose):
    """Only evaluation, and only of the sizes that the grid has in the end."""
    sizes = ("coarse=false", "steps_alone=40", "grow=[8]", "voxels=4096", "averaged=4", "rays=64")
    dvgo = assemble(compose("ctm=off", *(f"backbone.{each}" for each in sizes))).backbone
    for step in range(0, 12, 2):
        dvgo.average(step)
        assert (getattr(dvgo, "mean_field", None) is None) == (step < 8)
    with torch.no_grad():
        dvgo.mean_field.density.fill_(-100.0)
    batch = dvgo.draw(dvgo.draws(0))
    assert dvgo.predict(batch, dvgo.draws(0)).opacity.any()
    assert not dvgo.eval().render_rays(batch.rays).opacity.any()
    with torch.no_grad():
        dvgo.mean_field.density.fill_(100.0)
        dvgo.mean_mlp.layers[-1].bias.fill_(100.0)
    low, high = dvgo.field.grid.box
    points, directions = ((low + high) / 2)[None], torch.tensor([[0.0, 0.0, -1.0]])
    density, latent = dvgo.query(points, directions)
    assert density > 10
    assert (latent > 0.99).all()
    assert (dvgo.train().query(points, directions)[1] < 0.99).all()
