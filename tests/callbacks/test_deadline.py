"""Trainings of splats that end on time, on machines whose speed changes."""

import pytest
from faults import checkpoint, differences

from ctm_plugin.callbacks.deadline import MAX_STRETCH, MIN_STRETCH
from ctm_plugin.callbacks.preview import PREVIEW
from ctm_plugin.callbacks.stopwatch import Stopwatch
from ctm_plugin.errors import ConfigError, Interrupted
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.train import resume, train

SPLAT = ("backbone=splat", "ctm=off", "trainer.image_every=null", "backbone.steps=200", "backbone.grow_every=20")
PLANNED, MINUTES = 200, 1.0


@pytest.fixture
def speed(monkeypatch):
    """``speed(f)``: a step of the training takes ``f(seconds so far)`` seconds by its stopwatch."""

    def set_to(seconds_a_step):
        spent = {}

        def seconds(self):
            return spent.setdefault(id(self), self.before)

        def tick(self, trainer, *_):
            spent[id(self)] = seconds(self) + seconds_a_step(seconds(self))

        monkeypatch.setattr(Stopwatch, "seconds", property(seconds))
        monkeypatch.setattr(Stopwatch, "on_train_batch_end", tick)
        return spent

    return set_to


def config(compose, *more: str):
    return compose(*SPLAT, f"trainer.minutes={MINUTES}", *more)


@pytest.mark.slow
@pytest.mark.parametrize(
    "seconds_a_step",
    [
        lambda spent: 0.3,  # as planned
        lambda spent: 0.1,  # three times as fast
        lambda spent: 0.9,
        lambda spent: 0.1 if spent < 20 else 0.3,
        lambda spent: 0.3 if spent < 30 else 0.9,
        lambda spent: 0.9 if 15 < spent < 40 else 0.3,  # a neighbour that comes and goes
        lambda spent: 0.9 if int(spent / 7) % 2 else 0.3,
    ],
)
def test_it_ends_on_time(compose, tmp_path, speed, seconds_a_step):
    spent = speed(seconds_a_step)
    train(config(compose), tmp_path / "run", lambda *_: None)
    assert max(spent.values()) == pytest.approx(60 * MINUTES, rel=0.15)
    saved = checkpoint(tmp_path / "run")
    assert saved["turns"][-1][2] == saved["global_step"]


def test_the_whole_schedule_is_followed(compose, tmp_path, speed):
    """Learning rates end where they would have, Gaussians grow as often."""
    speed(lambda spent: 0.9)
    train(config(compose), tmp_path / "run", lambda *_: None)
    saved = checkpoint(tmp_path / "run")
    (means,) = saved["optimizer_states"][0]["means"]["param_groups"]
    assert saved["global_step"] < 0.5 * PLANNED
    assert means["lr"] == pytest.approx(0.01 * means["initial_lr"], rel=0.2)


@pytest.mark.parametrize(("seconds", "steps"), [(1e-4, MAX_STRETCH * 50), (100.0, MIN_STRETCH * 50)])
def test_there_is_a_longest_and_a_shortest_training(compose, tmp_path, speed, seconds, steps):
    speed(lambda spent: seconds)
    train(config(compose, "backbone.steps=50"), tmp_path / "run", lambda *_: None)
    assert checkpoint(tmp_path / "run")["global_step"] == pytest.approx(steps, rel=0.1)


@pytest.mark.parametrize("batch", [60, pytest.param(3, marks=pytest.mark.slow)])
def test_an_interrupted_run_goes_on_to_the_bit(compose, tmp_path, speed, ctrl_c, batch):
    """What was decided is in the checkpoint, and the time that is left."""
    given = config(compose, "trainer.checkpoint_every=1000")
    speed(lambda spent: 0.6)
    train(given, tmp_path / "whole", lambda *_: None)
    ctrl_c(lambda seen: seen == batch)
    with pytest.raises(Interrupted):
        train(given, tmp_path / "run", lambda *_: None)
    ctrl_c(lambda seen: False)
    resume(tmp_path / "run", lambda *_: None)
    turns = [checkpoint(tmp_path / name)["turns"] for name in ("whole", "run")]
    assert len(turns[0]) > 10
    before = [turn for turn in turns[0] if turn[0] <= batch]
    assert turns[1][: len(before)] == before
    assert abs(turns[1][-1][2] - turns[0][-1][2]) <= 2


def test_with_the_same_turns_it_ends_with_the_same_bits(compose, tmp_path, speed, ctrl_c, monkeypatch):
    """Where no mark comes after the interruption, nothing is decided anew."""
    given = config(compose, "backbone.steps=60", "trainer.checkpoint_every=1000")
    monkeypatch.setattr("ctm_plugin.callbacks.deadline.CLOCK_CHECKS", 2)
    speed(lambda spent: 2.0)
    train(given, tmp_path / "whole", lambda *_: None)
    ctrl_c(lambda seen: seen == 22)
    with pytest.raises(Interrupted):
        train(given, tmp_path / "run", lambda *_: None)
    ctrl_c(lambda seen: False)
    resume(tmp_path / "run", lambda *_: None)
    assert len(checkpoint(tmp_path / "run")["turns"]) == 2
    assert differences(tmp_path / "run", tmp_path / "whole") == []


def test_a_preview_is_written_after_a_tenth(compose, tmp_path, speed, ctrl_c, capsys):
    speed(lambda spent: 0.3)
    for stop, there in ((8, False), (30, True)):
        ctrl_c(lambda seen, stop=stop: seen == stop)
        with pytest.raises(Interrupted):
            train(config(compose), tmp_path / str(stop), lambda *_: None)
        assert (tmp_path / str(stop) / PREVIEW).exists() == there
    assert f"preview: {tmp_path / '30' / PREVIEW}" in capsys.readouterr().err.replace("\n", "")


def test_backbones_that_take_all_their_steps(compose):
    with pytest.raises(ConfigError, match=r"trainer\.minutes: found 2.0, expected null: backbone=dvgo takes all its"):
        assemble(compose("backbone=dvgo", "trainer.minutes=2"))
