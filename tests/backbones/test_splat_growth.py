"""Splats: growth, its counts, resets, and Adam's moments of what stays."""

import dataclasses

import pytest
import torch
from faults import checkpoint, differences
from splat_runs import SPLAT, interrupted, make, stepped

from ctm_plugin.backbones.splat import RESET_OPACITY, Splat
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.runs.train import train
from ctm_plugin.scene.views import Scene, Views
from ctm_plugin.splats.gaussians import Gaussians
from ctm_plugin.splats.growth import Change, along_curve


@pytest.fixture(scope="module")
def scene(ball) -> Scene:
    return BlenderConfig(root=ball).load()


def test_what_pulls_at_a_gaussian_is_counted(scene):
    """The gradient of its place on the picture, in halves of its sides, over the views that see it."""
    module = make(scene)
    expected, seen = torch.zeros(len(module.grad2d)), torch.zeros(len(module.grad2d))
    for step in range(3):
        module.batches_seen = step
        module.training_step(None, 0)["loss"].backward()
        ((shift, half),) = module.shifts
        assert half.tolist() == [6, 6]
        length = (shift.grad * 6).norm(dim=1)
        expected, seen = expected + length, seen + (length > 0)
        module.on_after_backward()
        assert not module.shifts
    torch.testing.assert_close(module.grad2d, expected)
    assert torch.equal(module.grad2d_count, seen)
    assert seen.max() == 3


def test_the_pull_does_not_hang_on_how_many_views_a_step_has(scene):
    """Two views at once pull as they do one after the other: the threshold means the same."""
    both, alone = make(scene, views=2, dssim=0.0), make(scene, dssim=0.0)
    stepped(both)
    for step in range(2):
        alone.batches_seen = step
        stepped(alone)
    torch.testing.assert_close(both.grad2d, alone.grad2d, atol=1e-7, rtol=1e-4)
    assert torch.equal(both.grad2d_count, alone.grad2d_count)


def test_pictures_that_nothing_follows_leave_nothing_behind(scene):
    """As benchmarks take steps: none of a Trainer's hooks is called."""
    module = make(scene)
    for _ in range(3):
        module.training_step(None, 0)["loss"].backward()
    assert len(module.shifts) == 1
    assert not make(scene).depths


@pytest.mark.parametrize(("times", "counted"), [(1, 40), (5, 40), (6, 48)])
def test_few_views_have_the_cap_of_forty(scene, times, counted):
    """Of 8 views, once and repeated."""
    train = scene.train
    more = Views(train.images.repeat(times, 1, 1, 1), train.c2w.repeat(times, 1, 1), train.intrinsics.repeat(times, 1),
                 tuple(map(str, range(times * len(train)))))  # fmt: skip
    module = make(dataclasses.replace(scene, train=more), per_pixel=0.1)
    assert module.cap_max == int(0.1 * counted * train.height * train.width)


def test_the_run_grows_and_has_its_optimizers(grown):
    _, run = grown
    saved = checkpoint(run)
    count = len(saved["state_dict"]["tables.means"])
    assert 200 < count <= 432
    assert (saved["global_step"], saved["batches_seen"]) == (20, 40)
    assert sorted(saved["optimizer_states"][0]) == ["appearance", "ctm", "means", "splats"]
    rates = {group["name"]: group["lr"] for group in saved["optimizer_states"][0]["splats"]["param_groups"]}
    assert rates["splats/shN"] == pytest.approx(rates["splats/sh0"] / 20)
    moments = saved["optimizer_states"][0]["means"]["state"][0]
    assert moments["exp_avg"].shape == (count, 3)
    assert saved["state_dict"]["grad2d_count"].max() > 0


@pytest.mark.parametrize("batch", [13, *(pytest.param(each, marks=pytest.mark.slow) for each in (4, 19, 33))])
def test_an_interrupted_run_goes_on_to_the_bit(grown, tmp_path, ctrl_c, batch):
    """Before anything grew and after, just before the reset and long after it."""
    config, whole = grown
    interrupted(config, tmp_path / "run", ctrl_c, batch)
    assert differences(tmp_path / "run", whole) == []


def test_a_reset_makes_all_nearly_transparent(scene):
    module = make(scene)
    optimizers = module.configure_optimizers()
    module.optimizers = lambda use_pl_optimizer: optimizers
    stepped(module)
    optimizers.step()
    module.tables["opacities"].data[3] = -9.0
    moments = optimizers.state[module.tables["opacities"]]
    assert moments["exp_avg"].any()
    with torch.no_grad():
        module._reset()
    assert module.gaussians.opacities.sigmoid().max().item() == pytest.approx(RESET_OPACITY)
    assert module.gaussians.opacities[3].item() == -9.0
    assert not moments["exp_avg"].any()
    assert not moments["exp_avg_sq"].any()


def test_harmonics_are_learned_one_degree_after_the_other(compose, tmp_path, monkeypatch):
    used, own = [], Splat.render

    def render(self, *args):
        used.append(self.degrees)
        return own(self, *args)

    monkeypatch.setattr(Splat, "render", render)
    train(compose(*SPLAT, "ctm=off", "backbone.degree=2", "backbone.degree_every=8"), tmp_path)
    assert used[:20] == [1] * 8 + [2] * 8 + [3] * 4
    assert set(used[20:]) == {3}


def test_it_grows_while_the_graph_of_an_earlier_step_lives(scene):
    module = make(scene)
    optimizers = module.configure_optimizers()
    module.optimizers = lambda use_pl_optimizer: optimizers
    kept = module.training_step(None, 0)["loss"]  # as a traceback would keep it
    kept.backward(retain_graph=True)
    optimizers.step()
    moments = optimizers.state[module.tables["means"]]["exp_avg"].clone()
    rows = torch.arange(len(module.grad2d)) >= 3
    with torch.no_grad():
        added = Gaussians(*(table[:7].clone() for table in module.gaussians))
        module._replace(Change(rows, added))
    stepped(module)
    optimizers.step()
    state = optimizers.state[module.tables["means"]]
    assert state["step"] == 2
    assert len(state["exp_avg"]) == len(moments) + 4
    assert len(optimizers.state) == len(module.tables)


def test_rows_that_stay_keep_their_moments_in_the_new_order(scene):
    module = make(scene)
    optimizers = module.configure_optimizers()
    module.optimizers = lambda use_pl_optimizer: optimizers
    stepped(module)
    optimizers.step()
    old = {
        name: torch.cat([table.detach(), *(optimizers.state[table][each] for each in ("exp_avg", "exp_avg_sq"))], 1)
        for name, table in module.tables.items()
    }
    kept = torch.arange(3, len(module.grad2d))
    with torch.no_grad():
        added = Gaussians(*(table[:7] + 5 for table in module.gaussians))
        module._replace(Change(kept, added))
    order = along_curve(module.tables["means"].detach())
    assert order.tolist() == list(range(len(kept) + 7))
    came = along_curve(torch.cat([old["means"][kept, :3], added.means]))
    assert came.tolist() != sorted(came.tolist())
    for name, table in module.tables.items():
        state, fresh = optimizers.state[table], getattr(added, name)
        new = torch.cat([old[name][kept], torch.cat([fresh, torch.zeros(7, 2 * fresh.shape[1])], 1)])[came]
        assert torch.equal(torch.cat([table.detach(), state["exp_avg"], state["exp_avg_sq"]], 1), new)
