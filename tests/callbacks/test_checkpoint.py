"""When checkpoints are written, and what signals do."""

import io
import resource
import signal
import threading
import tracemalloc
from pathlib import Path

import lightning as L
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from toy import Toy, small_ctm, trainer

from ctm_plugin.callbacks.checkpoint import SIGNALS, CheckpointFile, LastCheckpoint
from ctm_plugin.errors import CheckpointError, Interrupted


class Recorded(LastCheckpoint):
    """Notes the steps at which it saves."""

    def __init__(self, run, every):
        super().__init__(run, run / "last.ckpt", run / "previous.ckpt", every)
        self.steps = []

    def save(self, trainer):
        super().save(trainer)
        self.steps.append(trainer.global_step)
        assert trainer.lightning_module.batches_seen == trainer.global_step * trainer.accumulate_grad_batches


class Signal(L.Callback):
    """Sends signals from inside hooks of a training."""

    def __init__(self, hook: str, batch: int = 0, number: signal.Signals = signal.SIGINT, times: int = 1):
        def send(trainer, pl_module, *args):
            if pl_module.batches_seen == batch:
                for _ in range(times):
                    signal.raise_signal(number)

        setattr(self, hook, send)


def fit(last: LastCheckpoint, *callbacks: L.Callback, steps: int = 7, accumulate: int = 1) -> L.Trainer:
    fitter = trainer(steps, *callbacks, last, accumulate_grad_batches=accumulate)
    with last.listening():
        fitter.fit(Toy(steps, small_ctm()))
    return fitter


def step_of(run) -> int:
    return torch.load(run / "last.ckpt", weights_only=True)["global_step"]


@pytest.fixture(autouse=True)
def handlers():
    """Whatever a test does, the handlers are as before in the end."""
    # A shell starts its background jobs with SIGINT ignored; tests are to run alike there.
    outer = signal.signal(signal.SIGINT, signal.default_int_handler)
    before = [signal.getsignal(number) for number in SIGNALS]
    yield
    after = [signal.getsignal(number) for number in SIGNALS]
    signal.signal(signal.SIGINT, outer)
    assert after == before


@given(st.integers(1, 9), st.integers(1, 9), st.integers(1, 3))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=15)
def test_saves_every_so_many_steps_and_at_the_end(tmp_path, steps, every, accumulate):
    last = Recorded(tmp_path, every)
    fit(last, steps=steps, accumulate=accumulate)
    assert last.steps == sorted({*range(every, steps + 1, every), steps})
    assert {path.name for path in tmp_path.iterdir()} - {"previous.ckpt"} == {"last.ckpt"}
    assert step_of(tmp_path) == steps


@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize(
    ("hook", "batch", "accumulate", "step"),
    [
        ("on_train_batch_start", 1, 1, 2), ("on_before_backward", 4, 3, 2), ("on_before_optimizer_step", 6, 3, 2),
    ],
)  # fmt: skip
def test_a_signal_ends_the_run_after_the_step_in_progress(tmp_path, number, hook, batch, accumulate, step):
    last = Recorded(tmp_path, 100)
    fitter = fit(last, Signal(hook, batch, number), accumulate=accumulate)
    assert last.stopped
    assert last.steps == [step]
    assert step_of(tmp_path) == fitter.global_step == step


def test_a_signal_between_two_steps_ends_the_run_after_the_next(tmp_path):
    last = Recorded(tmp_path, 100)
    fitter = trainer(7, last, Signal("on_train_batch_end", 3))  # after it
    with last.listening():
        fitter.fit(Toy(7, small_ctm()))
    assert last.steps == [4]


@pytest.mark.parametrize(("batch", "validated"), [(3, [2]), (4, [2, 4])])
def test_a_stop_validates_no_more_than_is_due(tmp_path, batch, validated):
    seen, look = [], L.Callback()
    look.on_validation_end = lambda trainer, *_: seen.append(trainer.global_step)
    callbacks = [Signal("on_train_batch_end", batch), look, last := Recorded(tmp_path, 100)]
    often = {"limit_val_batches": 1, "val_check_interval": 2, "check_val_every_n_epoch": None}
    with last.listening():
        trainer(7, *callbacks, num_sanity_val_steps=0, **often).fit(Toy(7, small_ctm()))
    assert last.steps == [batch]
    assert seen == validated


@pytest.mark.parametrize("hook", ["setup", "on_fit_start", "on_train_start"])
def test_a_signal_before_the_first_step_ends_the_run(tmp_path, hook):
    early = L.Callback()
    setattr(early, hook, lambda *args, **kwargs: signal.raise_signal(signal.SIGINT))
    with pytest.raises(Interrupted, match="stopped before the first step; go on with: python -m ctm_plugin resume="):
        fit(Recorded(tmp_path, 1), early)
    assert not list(tmp_path.iterdir())


def test_a_second_signal_ends_it_at_once(tmp_path):
    with pytest.raises(SystemExit):
        fit(Recorded(tmp_path, 100), Signal("on_before_backward", 3, times=2))
    assert not list(tmp_path.iterdir())


def test_a_signal_in_the_last_step_is_not_lost(tmp_path):
    last = Recorded(tmp_path, 100)
    fit(last, Signal("on_before_backward", 7))
    assert last.steps == [7]
    assert last.signalled


def test_handlers_are_put_back_after_an_error(tmp_path):
    class Fail(L.Callback):
        def on_train_batch_end(self, *args):
            raise RuntimeError("ours")

    with pytest.raises(RuntimeError, match="ours"):
        fit(Recorded(tmp_path, 100), Fail())


def test_trains_without_signals_in_another_thread(tmp_path):
    last = Recorded(tmp_path, 5)
    thread = threading.Thread(target=fit, args=(last,))
    thread.start()
    thread.join()
    assert last.steps == [5, 7]


@pytest.mark.parametrize("told", [True, False], ids=["told", "silent"])
def test_the_old_checkpoint_stays_until_the_new_one_is_whole(tmp_path, monkeypatch, told):
    save = L.Trainer.save_checkpoint

    def until_the_disk_is_full(self, path):
        save(self, path)
        if self.global_step == 4:
            path.write_bytes(path.read_bytes()[:100])
            if told:
                raise OSError("disk full")

    monkeypatch.setattr(L.Trainer, "save_checkpoint", until_the_disk_is_full)
    with pytest.raises(CheckpointError, match=f"disk full.*{tmp_path / 'last.ckpt'}" if told else "last good one kept"):
        fit(Recorded(tmp_path, 2))
    assert step_of(tmp_path) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["last.ckpt"]


def test_a_checkpoint_is_not_copied_in_memory_first(tmp_path):
    state = {"table": torch.randn(1 << 20), "step": 3}
    tracemalloc.start()
    try:
        CheckpointFile().save_checkpoint(state, tmp_path / "last.ckpt")
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()
    loaded = CheckpointFile().load_checkpoint(tmp_path / "last.ckpt", weights_only=True)
    assert torch.equal(loaded["table"], state["table"])
    assert loaded["step"] == 3


def test_a_file_without_room_says_what_the_system_says(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, before[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            CheckpointFile().save_checkpoint({"table": torch.randn(1 << 20)}, tmp_path / "last.ckpt")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_ctrl_c_while_writing_stays_one(tmp_path, monkeypatch):
    class Interrupting(io.FileIO):
        def write(self, part):
            if self.tell() > 1 << 16:
                raise KeyboardInterrupt
            return super().write(part)

    monkeypatch.setattr(Path, "open", lambda path, mode: Interrupting(path, mode))
    with pytest.raises(KeyboardInterrupt):
        CheckpointFile().save_checkpoint({"tables": [torch.randn(1 << 14) for _ in range(9)]}, tmp_path / "a")
