"""Splats: pictures that grow while a run trains."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from faults import differences
from splat_runs import GROWS, SPLAT, interrupted, make, stepped

from ctm_plugin.backbones.splat import Splat
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.runs.load import load_posed
from ctm_plugin.runs.train import train
from ctm_plugin.scene.views import Scene
from ctm_plugin.splats import coarse_to_fine


@pytest.fixture(scope="module")
def scene(ball) -> Scene:
    return BlenderConfig(root=ball).load()


def tiny(patch: pytest.MonkeyPatch) -> None:
    """Let pictures of 12 pixels be averaged."""
    patch.setattr(coarse_to_fine, "MIN_SIDE", 3)
    patch.setattr(coarse_to_fine, "OCTAVES", 3)


@pytest.fixture(scope="module")
def coarse(compose, tmp_path_factory) -> tuple[dict[str, Any], Path, list[tuple[int, int]], list[int]]:
    """A run whose pictures have 3, 6 and 12 pixels a side, with alpha and masks' appearance; each step's width; the
    steps that Adam's moments begin anew with.
    """
    config = compose(*SPLAT, *GROWS, "ctm=off", "appearance=exposure", "backbone.steps=18", "dataset.exposure=0.2")
    widths, anew, render = [], [], Splat.render
    with pytest.MonkeyPatch.context() as patch:
        tiny(patch)

        def seen(self, views, index, background, draws, every=1):
            if draws is not None:
                widths.append((self.global_step, views.width))
                moments = [self.named_optimizers.state.get(table, {}) for table in self.tables.values()]
                if not any(each["exp_avg"].any() or each["exp_avg_sq"].any() for each in moments if each):
                    anew.append(self.global_step)
            return render(self, views, index, background, draws, every)

        patch.setattr(Splat, "render", seen)
        run = tmp_path_factory.mktemp("coarse") / "whole"
        train(config, run)
    return config, run, widths, anew


def test_pictures_grow_while_it_trains(coarse, monkeypatch):
    _, run, widths, anew = coarse
    tiny(monkeypatch)
    module = load_posed(run).module
    assert [stage.side for stage in module.stages] == [4, 2]
    ends = [math.ceil(18 * stage.until) for stage in module.stages]
    assert 0 < ends[0] < ends[1] < 18
    assert widths == [(step, 3 if step < ends[0] else 6 if step < ends[1] else 12) for step in range(18)]
    assert set(anew) - {5, 10, 15} == {0, *ends}  # growth may replace all
    assert module.rays(0, 18) == pytest.approx(sum(width**2 for _, width in widths))
    # Most of its steps are cheap; what it renders and is scored by is whole.
    assert module.cost(0, 18) < 0.8 * Splat(dataclasses.replace(module.config, coarse=False), module.scene).cost(0, 18)
    assert module.render_view(module.scene.test, 0)["rgb"].shape == (12, 12, 3)


@pytest.mark.parametrize(("width", "place"), [(3, 1), (3, -1), (6, 1), (12, 1)])
def test_it_goes_on_to_the_bit_in_the_middle_of_a_size_and_at_its_end(
    coarse, width, place, tmp_path, ctrl_c, monkeypatch
):
    config, whole, widths, _ = coarse
    tiny(monkeypatch)
    batch = [step for step, each in widths if each == width][place]
    interrupted(config, tmp_path / "run", ctrl_c, batch)
    assert differences(tmp_path / "run", whole) == []


def test_small_pictures_pull_as_the_whole_ones_do(scene):
    """The gradient of what is large on the picture is that of whole pictures, but for what squares do not show."""
    module = make(scene, dssim=0.0, degree=0, first=20)
    with torch.no_grad():
        module.tables["scales"].fill_(math.log(0.6))
    stepped(module)
    expected = {name: table.grad.clone() for name, table in module.tables.items()}
    module.zero_grad()
    module.batches_seen = 0
    module.learn_from(coarse_to_fine.averaged(scene.train, 2))
    module.cameras.clear()
    stepped(module)
    for name in ("means", "scales", "opacities", "sh0"):  # round ones have no turn
        found, wanted = module.tables[name].grad.flatten(), expected[name].flatten()
        assert (found - wanted).norm() < 0.4 * wanted.norm(), name
