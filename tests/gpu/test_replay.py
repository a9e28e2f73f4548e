"""Steps that are replayed, on the CPU: what a CUDA graph does is done there by a tape of operators."""

import copy

import pytest
import tape
import torch
from pages import load

from ctm_plugin import door
from ctm_plugin.backbones import nerf_field, occupied
from ctm_plugin.color.spaces.rgb import Space as RGB
from ctm_plugin.draws import Draws, KnownDraws, NotedDraws
from ctm_plugin.gpu import replay
from ctm_plugin.rays import packing
from ctm_plugin.runs.assemble import assemble

subject = load("benchmarks/step.py")
BRIEF = ("trainer=quick", "trainer.precision=32-true", "backbone.rays=64")
VOXELS = ("backbone=dvgo", "backbone.voxels=4096", "backbone.coarse_voxels=2000")
SETTINGS = {
    "grows, random backgrounds": (
        *VOXELS, "backbone.coarse=false", "backbone.grow=[24]", "dataset.background=random", "ctm=on"
    ),
    "a coarse stage, learned exposures": (
        *VOXELS, "backbone.coarse=true", "backbone.coarse_steps=15", "backbone.grow=[]", "appearance=exposure",
    ),
    "a hash grid": (
        "backbone=ngp", "backbone.occupancy_first=4", "backbone.occupancy_every=4", "backbone.log2_entries=10",
        "backbone.levels=2", "backbone.cells=1000", "backbone.samples=32", "ctm=quick",
    ),
    "NeRF": ("backbone=nerf", "backbone.width=32", "backbone.density_noise=1", "color_space=hsv"),
}  # fmt: skip


@pytest.fixture(autouse=True)
def a_gpu(monkeypatch):
    """As far as replays know, and none of the CPU's own ways."""
    monkeypatch.setattr(replay, "may_record", lambda _: torch.is_grad_enabled())
    monkeypatch.setattr(replay, "record", tape.record)
    monkeypatch.setattr(occupied, "placed_samples", tape.kernel(occupied.placed_samples))
    monkeypatch.setattr(door, "may_run", lambda _: False)
    monkeypatch.setattr(nerf_field, "blocks_of_samples", nerf_field.all_samples)


@pytest.fixture
def recordings(monkeypatch):
    """One item for each."""
    made, init = [], replay.Recorded.__init__

    def noted(self, *args):
        made.append(self)
        init(self, *args)

    monkeypatch.setattr(replay.Recorded, "__init__", noted)
    return made


@pytest.fixture(scope="module")
def parts_of(compose):
    return lambda name, *more: assemble(compose("trainer.replay=true", *BRIEF, *SETTINGS[name], *more))


@pytest.fixture
def side(parts_of):
    """A backbone whose optimizers rest, but the transform's."""
    parts = parts_of("grows, random backgrounds")
    return subject.Side(parts.backbone, parts.attach, False)


@pytest.mark.parametrize("name", SETTINGS)
@pytest.mark.slow
def test_every_step_of_a_training_is_the_same(name, parts_of, recordings, monkeypatch):
    """It has the loss and the gradients that one operator at a time finds."""
    steps, compared = {"NeRF": 5, "a hash grid": 20}.get(name, 40), []
    parts = parts_of(name)
    module = parts.backbone

    def compare() -> None:
        had = [each for each in module.parameters() if each.grad is not None]
        with monkeypatch.context() as patch, torch.enable_grad():
            patch.setattr(packing.Places, "watch", lambda *_: None)
            step = module.step_of(module.draws(module.batches_seen - 1))
            grads = torch.autograd.grad(step.loss, had)
        torch.testing.assert_close(sum(module.terms.values()), step.loss.detach(), rtol=1e-4, atol=0)
        compared.append([float((each.grad - grad).norm() / grad.norm()) for each, grad in zip(had, grads, strict=True)])

    module.on_after_backward = compare
    subject.warm(parts, steps)
    assert len(compared) == steps
    assert max(map(max, compared)) < 1e-3
    assert len(recordings) == (1 if name in ("NeRF", "a hash grid") else 2)


def replaying(side, steps: int = 12) -> list:
    """What its last steps gave."""
    return [side.module.training_step(None, 0) for _ in range(steps)]


def test_samples_without_a_place_are_noticed(side, recordings, monkeypatch):
    monkeypatch.setattr(packing, "STEPS_BETWEEN_CHECKS", 16)
    monkeypatch.setattr(packing, "SPARE_FACTOR", 0.0)
    monkeypatch.setattr(replay, "TOLERANCE", torch.inf)
    replaying(side, 10)
    places = side.module.places.found
    assert places == (1024, 1023, 1022)
    monkeypatch.setattr(packing, "SPARE_FACTOR", 1.25)
    replaying(side, 16)
    assert side.module.places.found[0] > places[0]
    assert len(recordings) == 2


def test_other_packages_parts_are_not_recorded(side, recordings):
    class Other(RGB):
        """Which may do something else in every step."""

    Other.__module__ = "outside"
    side.module.transform = Other()
    replaying(side)
    assert not recordings


def test_it_has_to_be_asked_for(compose, recordings):
    parts = assemble(compose(*BRIEF, *SETTINGS["grows, random backgrounds"]))
    replaying(subject.Side(parts.backbone, parts.attach, False))
    assert not recordings


def test_a_copy_is_recorded_anew(side, recordings):
    replaying(side)
    module = copy.deepcopy(side.module)
    assert module.replay.recorded is None
    module.training_step(None, 0)
    assert len(recordings) == 2


def test_evaluation_is_not_recorded(side, recordings):
    with torch.no_grad():
        replaying(side)
    assert not recordings


def broken(compute):
    raise RuntimeError("no graphs here")


def wrong(compute):
    step, grads = compute()
    return lambda: None, (step, tuple(2 * grad for grad in grads))


@pytest.mark.parametrize(("record", "told"), [(broken, "no graphs here"), (wrong, "something else")])
def test_refused(record, told, side, recordings, monkeypatch):
    monkeypatch.setattr(replay, "record", record)
    with pytest.warns(UserWarning, match=f"not replayed.*{told}"):
        replaying(side)
    replaying(side)[-1]["loss"].backward()
    assert len(recordings) == 1
    assert side.module.replay.recorded is None


def test_a_wait_is_refused(side, monkeypatch):
    step_of = side.module.step_of
    monkeypatch.setattr(side.module, "step_of", lambda draws: step_of(draws) if step_of(draws).loss.item() else None)
    with pytest.warns(UserWarning, match="would wait"):
        replaying(side)


def test_draws_are_noted_and_known():
    noted = NotedDraws(Draws(0, 1))
    made = [noted.uniform(3, 2), noted.normal(2, 2), noted.integers(9, 4)]
    assert noted.asked == [("uniform", (3, 2)), ("normal", (2, 2)), ("integers", (9, 4))]
    draws = Draws(0, 1)
    for each, again in zip(made, [draws.uniform(3, 2), draws.normal(2, 2), draws.integers(9, 4)], strict=True):
        torch.testing.assert_close(each, again, rtol=0, atol=0)
    known = KnownDraws(draws, noted.given)
    assert [known.uniform(3, 2), known.normal(2, 2), known.integers(9, 4)] == made
