"""Training time over interruptions, on a clock that the tests wind."""

import lightning as L
import pytest
import torch
from toy import Clock, Toy, small_ctm, trainer

from ctm_plugin.callbacks import stopwatch
from ctm_plugin.callbacks.stopwatch import Stopwatch, peak_memory_mb
from ctm_plugin.color.settings import TransformTraining


@pytest.fixture
def clock(monkeypatch) -> Clock:
    clock = Clock(now=1000.0)
    monkeypatch.setattr(stopwatch, "time", clock)
    return clock


class Work(L.Callback):
    """A step takes a second, saving and scoring after it a hundred, pre-training ten."""

    def __init__(self, clock, path=None, save_at=None):
        self.clock, self.path, self.save_at = clock, path, save_at

    def on_train_start(self, trainer, pl_module):
        if pl_module.batches_seen == 0:
            self.clock.now += 10.0

    def on_before_backward(self, *args):
        self.clock.now += 1.0

    def on_train_batch_end(self, trainer, *args):
        if trainer.global_step == self.save_at:
            trainer.save_checkpoint(self.path)
        if trainer.global_step == trainer.max_steps:
            self.clock.now += 100.0


def fit(watch: Stopwatch, work: Work, resume=None, steps: int = 4) -> None:
    toy = Toy(steps, small_ctm(learning=TransformTraining(pretrain_steps=1)))
    trainer(steps, watch, work).fit(toy, ckpt_path=resume, weights_only=True)


def test_counts_training_alone(clock):
    watch = Stopwatch()
    fit(watch, Work(clock))
    clock.now += 50.0
    assert watch.seconds == 14.0
    assert watch.state_dict()["seconds"] == 14.0


@pytest.mark.parametrize("step", [1, 3])
def test_counts_on_after_an_interruption(clock, tmp_path, step):
    fit(Stopwatch(), Work(clock, tmp_path / "x.ckpt", step))
    watch = Stopwatch()
    fit(watch, Work(clock), tmp_path / "x.ckpt")
    assert watch.seconds == 14.0


def test_a_finished_training_takes_no_longer(clock, tmp_path):
    first = Stopwatch()
    fit(first, Work(clock, tmp_path / "x.ckpt", 4))
    again = Stopwatch()

    class Slow(L.Callback):
        def on_fit_start(self, *args):
            clock.now += 7.0

    trainer(4, again, Slow()).fit(Toy(4, small_ctm()), ckpt_path=tmp_path / "x.ckpt", weights_only=True)
    assert again.state_dict() == first.state_dict()


def test_the_largest_memory_of_all_parts_is_kept(monkeypatch, tmp_path, clock):
    monkeypatch.setattr(stopwatch, "peak_memory_mb", lambda device: 500.0)
    fit(Stopwatch(), Work(clock, tmp_path / "x.ckpt", 2))
    monkeypatch.setattr(stopwatch, "peak_memory_mb", lambda device: 300.0)
    watch = Stopwatch()
    fit(watch, Work(clock), tmp_path / "x.ckpt")
    assert watch.peak_memory_mb == 500.0


def test_memory_is_in_mebibytes():
    """PyTorch alone takes more than a hundred, and no test a hundred thousand."""
    assert 100 < peak_memory_mb(torch.device("cpu")) < 100_000
