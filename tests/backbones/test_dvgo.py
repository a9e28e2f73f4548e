"""DVGO's two stages, and what happens where its grid grows."""

import pytest
import torch

from ctm_plugin.backbones.dvgo import DVGO
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
    del seen["saved"]["dvgo"]["dropped"]  # as checkpoints of before 0.2 are
    seen["fresh"].on_load_checkpoint(seen["saved"])
    assert seen["fresh"].field.vertex_shift == seen["before"]


@pytest.mark.parametrize("least", [0, 3, 8, 100])
def test_coarse_voxels_that_few_views_see_are_free(compose, least):
    dvgo = assemble(compose("backbone.coarse=true", f"backbone.coarse_views={least}")).backbone
    seen, _ = view_counts(dvgo.field.lattice.vertices(), dvgo.scene.train, dvgo.scene.near)
    assert seen.min() < 3 < seen.max() == len(dvgo.scene.train) == 8
    dvgo.mask_rarely_seen(seen)
    # More views than there are would leave nothing.
    torch.testing.assert_close(dvgo.field.occupancy, seen >= min(least, 8))
