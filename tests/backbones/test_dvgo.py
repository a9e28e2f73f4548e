"""DVGO's two stages, what happens where its grid grows, forward-facing scenes."""

import json
from dataclasses import replace

import pytest
import torch

from ctm_plugin.backbones.dvgo import DVGO
from ctm_plugin.backbones.spaces import Box, NDCSpace
from ctm_plugin.color.spaces.rgb import Space as RGB
from ctm_plugin.errors import ConfigError
from ctm_plugin.rays.grid import add_smoothing
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.rundir import LAST
from ctm_plugin.runs.train import train
from ctm_plugin.scene.frustum import view_counts


@pytest.mark.parametrize(
    ("decay", "coarse", "fine", "of_coarse", "of_fine"),
    [("null", 100, 300, 300, 300), ("null", 900, 300, 900, 300), ("50", 900, 300, 50, 50)],
)
@pytest.mark.parametrize("final", [0.1, 0.2])
def test_rates_fall_to_what_they_are_asked_to(compose, decay, coarse, fine, of_coarse, of_fine, final):
    given = {"lr_decay_steps": decay, "coarse_steps": coarse, "steps": fine, "coarse": "true", "lr_final": final}
    dvgo = assemble(compose("backbone=dvgo", *(f"backbone.{key}={value}" for key, value in given.items()))).backbone
    for stage, start, length in (("coarse", 0, of_coarse), ("fine", coarse, of_fine)):
        dvgo.stage = stage
        schedule = dvgo.field_schedule()
        assert schedule(start) == 1
        assert schedule(start + length) == pytest.approx(final)
        assert schedule(start + length // 2) == pytest.approx(final**0.5)


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


WALL, BOARD = 6.0, 3.0
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


@pytest.mark.slow
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


def test_coarse_stage_is_for_lit_scenes_before_nothing(compose):
    dvgo = assemble(compose("backbone.coarse=auto")).backbone
    assert dvgo.wants_coarse()
    train = dvgo.scene.train
    dvgo.scene = replace(dvgo.scene, train=replace(train, images=train.images[..., :3].contiguous()))
    assert not dvgo.wants_coarse()
    assert not assemble(compose("backbone.coarse=auto", "dataset.exposure=0.02")).backbone.wants_coarse()


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


# Forward-facing scenes: a painted wall and a board in front of it (``hall``)


@pytest.fixture
def llff(hall, compose):
    return lambda *more: compose("dataset=llff", f"dataset.root={hall}", "backbone=dvgo", *more)


SIZES = (
    "backbone.planes=24", "backbone.voxels=24000", "backbone.grow=[40]", "backbone.rays=256",
    "backbone.steps_alone=120", "backbone.tv_dense_steps=80", "backbone.lr_grid=0.3", "backbone.lr_mlp=0.003",
    "backbone.occupancy_first=25",
)  # fmt: skip


@pytest.mark.slow
def test_learns_colours_and_depth(llff, tmp_path):
    """With CTM, under which less of it is certain."""
    train(llff(*SIZES, "ctm=quick", "ctm.pretrain_steps=200"), tmp_path / "run")
    result = json.loads((tmp_path / "run" / "metrics.json").read_text())
    # The wall's mean colour alone gives about 10 dB, the mean depth an error of 0.75 x the spread of the depths.
    assert result["psnr"] > 22
    scale = 1 / (0.75 * (BOARD - 0.5))
    assert result["depth_mae"] < 0.3 * (WALL - BOARD) * scale


def test_the_geometry_of_the_data_picks_the_space_and_the_paper_s_sizes(llff, compose):
    forward = assemble(llff("trainer=paper", "backbone.voxels=8000", "backbone.planes=8")).backbone
    assert type(forward.field.space) is NDCSpace
    config = forward.config
    assert (config.features, forward.field.color.layers[0].out_features, config.rays) == (9, 64, 4096)
    assert (config.step_size, config.grow, forward.total_steps) == (0.5, (2000, 4000, 6000, 8000), 30000)
    assert type(assemble(compose("backbone=dvgo")).backbone.field.space) is Box
    assert type(assemble(llff("backbone.geometry=bounded")).backbone.field.space) is Box


def test_forward_facing_scenes_have_no_coarse_stage(llff):
    with pytest.raises(ConfigError, match=r"backbone\.coarse: found True, expected false or auto"):
        assemble(llff("backbone.coarse=true"))


def test_unbounded_scenes_are_not_supported_yet(llff):
    with pytest.raises(ConfigError, match=r"backbone\.geometry: found 'unbounded', expected bounded or forward"):
        assemble(llff("dataset.geometry=unbounded"))


def test_a_data_set_that_does_not_say_its_geometry(llff):
    config = llff()
    config["backbone"]["geometry"] = None
    with pytest.raises(ConfigError, match="given as a key: hall is forward"):
        assemble(config)


def test_planes_keep_their_number_when_the_grid_grows(llff):
    module = assemble(llff("backbone.planes=16", "backbone.voxels=32000", "backbone.grow=[5, 10]")).backbone
    shapes = []
    for grown in range(3):
        module.grown = grown
        shapes.append(module.grown_shape(module.field.grid.aabb))
    assert [shape[2] for shape in shapes] == [16] * 3
    assert shapes[0][0] * shapes[0][1] < shapes[1][0] * shapes[1][1] < shapes[2][0] * shapes[2][1]
    torch.testing.assert_close(module.field.grid.aabb[:, 2], torch.tensor([-1.0, 1.0]))
