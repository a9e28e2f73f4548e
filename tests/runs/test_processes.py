"""Two processes on the CPU train what one process does, and start, stop and fail together."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import ddp_rank
import pytest
import torch
from faults import differing
from forked import Command

from ctm_plugin.errors import CTMError
from ctm_plugin.runs import processes as distributed
from ctm_plugin.runs.processes import processes
from ctm_plugin.runs.rundir import LAST, METRICS
from ctm_plugin.runs.train import train

# Pre-training, the change of stage after 4 steps, a growth after 2 more, the occupancy grid one later; 8 steps of 2
# batches. Learning rates are large enough for the coarse stage to find the ball.
STAGES = (
    "dataset.background=random_matched", "appearance=exposure", "ctm.lr=0.01", "ctm.pretrain_steps=100",
    "backbone.coarse=true", "backbone.coarse_steps=4", "backbone.coarse_lr_grid=8", "backbone.steps=4",
    "backbone.grow=[2]", "backbone.occupancy_first=3", "backbone.rays=128", "trainer.accelerator=cpu",
    "trainer.accumulate_grad_batches=2",
)  # fmt: skip
TWO = ("trainer.devices=2",)
TORCHRUN = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2")
OTHERS = {"PYTHONPATH": str(Path(distributed.__file__).parents[2])}
"""With which the other process, a fresh one, finds the package under test, installed or not."""


@pytest.mark.slow
def test_two_processes_end_alike_and_step_as_one_does(arguments, compose, tmp_path):
    """Under torchrun. Both to the bit alike, as they step by the same sums; as one process but for rounding."""
    config = compose(*STAGES)
    train(config, tmp_path / "one")
    folder = f"hydra.run.dir={tmp_path / 'two'}"
    command = [*TORCHRUN, ddp_rank.__file__, str(tmp_path), *arguments, *STAGES, *TWO, folder]
    both = subprocess.run(command, env=os.environ | OTHERS, capture_output=True, text=True, timeout=120)
    assert both.returncode == 0, both.stderr

    first, second = (torch.load(tmp_path / f"rank{rank}.pt", weights_only=True) for rank in (0, 1))
    assert first["batches"] == second["batches"] == 16
    saved = torch.load(tmp_path / "two" / LAST, weights_only=True)
    box = saved["dvgo"]["box"]
    assert float((box[1] - box[0]).max()) < 3
    for part in ("weights", "optimizer"):
        assert list(differing(first[part], second[part])) == []
    assert len(list(tensors(first["optimizer"]))) > 20
    assert list(differing(first["weights"], saved["state_dict"])) == []
    assert len(first["steps"]) == len(second["steps"]) == 8
    apart = sorted(ddp_rank.apart(config, steps) for steps in zip(first["steps"], second["steps"], strict=True))
    assert apart[-2] < ddp_rank.APART  # in one step a colour may be clipped by rounding, which its gradient shows
    one, two = (json.loads((tmp_path / run / METRICS).read_text()) for run in ("one", "two"))
    assert two["psnr"] == pytest.approx(one["psnr"], abs=1e-2)
    assert two["steps"] == one["steps"] == 8


def tensors(nest):
    if isinstance(nest, torch.Tensor):
        yield nest
    elif isinstance(nest, dict):
        for value in nest.values():
            yield from tensors(value)


@pytest.mark.slow
def test_a_sweep_of_two_processes_a_job(arguments, tmp_path):
    """Each job starts its other process by itself, though the command line is a sweep's with a time stamp."""
    sizes = ("backbone.steps_alone=2", "backbone.grow=[]", "backbone.rays=16", "trainer.accelerator=cpu")
    folders = f"hydra.sweep.dir={tmp_path}/sweeps/${{now:%H-%M-%S-%f}}"
    sweep = ("backbone.coarse=false", *sizes, *TWO, "-m", "seed=0", folders)
    done = Command(*arguments, *sweep, told=tmp_path / "told", **OTHERS)
    output, error = done.communicate()
    assert done.returncode == 0, error
    assert output.count("written to") == 1
    (sweep,) = (tmp_path / "sweeps").iterdir()
    assert sorted(path.name for path in sweep.iterdir()) == ["0_blender_dvgo_ctm-on_seed0", "multirun.yaml"]
    for run in sweep.glob("*_seed*"):
        kinds = {"depth", "latent", "lit", "photo", "checkpoints", "tensorboard"}
        files = {"cameras.json", "config.yaml", "data.json", "metrics.json"}
        assert {path.name for path in run.iterdir()} == kinds | files
        writers = [path.name.split(".")[-2] for path in (run / "tensorboard").rglob("events*")]
        assert len(writers) == 2  # the curves, the scores
        assert len(set(writers)) == 1  # one process of two
        assert json.loads((run / METRICS).read_text())["steps"] == 2


@pytest.mark.slow
def test_two_processes_end_on_time_alike(arguments, tmp_path):
    """The first one's clock cuts or stretches the schedule of both: to what 3 seconds allow, a quarter at least."""
    splats = ("backbone=splat", "ctm=off", "trainer.image_every=null", "backbone.steps=100", "backbone.views=2")
    splats += ("trainer.minutes=0.05",)
    command = [*TORCHRUN, ddp_rank.__file__, str(tmp_path), *arguments, *splats, "trainer.accelerator=cpu", *TWO]
    command += [f"hydra.run.dir={tmp_path / 'run'}"]
    both = subprocess.run(command, env=os.environ | OTHERS, capture_output=True, text=True, timeout=120)
    assert both.returncode == 0, both.stderr
    first, second = (torch.load(tmp_path / f"rank{rank}.pt", weights_only=True) for rank in (0, 1))
    saved = torch.load(tmp_path / "run" / LAST, weights_only=True)
    assert len(saved["turns"]) > 1
    assert saved["turns"][-1][2] == saved["global_step"]
    assert first["batches"] == second["batches"] == saved["batches_seen"]
    assert list(differing(first["weights"], second["weights"])) == []


@pytest.mark.slow
def test_ctrl_c_in_one_process_stops_both_in_the_same_step(arguments, tmp_path):
    run = tmp_path / "run"
    long = ("backbone.steps=100000", "backbone.occupancy_first=50000", "trainer.checkpoint_every=3")
    command = (*arguments, *STAGES, *long, *TWO, f"hydra.run.dir={run}")
    process = Command(*command, told=tmp_path / "told", **OTHERS)
    until = time.monotonic() + 120
    while not (run / LAST).exists() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130, error
    saved = torch.load(run / LAST, weights_only=True)
    assert error.count("stopped after step") == 1
    assert error.splitlines()[-1].startswith(f"stopped after step {saved['global_step']}; go on with: ")
    assert saved["batches_seen"] == 2 * saved["global_step"]


def test_the_failure_of_another_process_is_told(tmp_path, capfd, monkeypatch):
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\necho "rank $LOCAL_RANK: no $3" >&2\nexit 1\n')
    python.chmod(0o700)
    monkeypatch.setattr(distributed.sys, "executable", str(python))
    before = dict(os.environ)
    with pytest.raises(CTMError, match="process 1 of the run ended with exit code 1"), processes(tmp_path / "no", 2):
        raise RuntimeError(f"connection lost to rank {os.environ['LOCAL_RANK']}")
    assert f"rank 1: no resume={tmp_path / 'no'}" in capfd.readouterr().err
    assert dict(os.environ) == before


def test_an_error_of_our_own_stays_and_ends_the_others(tmp_path, monkeypatch):
    started = []
    popen = subprocess.Popen

    def sleeper(command, env):
        started.append(popen([sys.executable, "-c", "import time; time.sleep(60)"], env=env))
        return started[0]

    monkeypatch.setattr(distributed.subprocess, "Popen", sleeper)
    with pytest.raises(CTMError, match="ours"), processes(tmp_path, 2):
        raise CTMError("ours")
    assert started[0].returncode == -signal.SIGKILL


def test_a_process_left_waiting_is_ended(monkeypatch, capsys):
    """When another one dies in the middle of an exchange, no exception comes: the thread that watches ends this one."""
    ended = []
    monkeypatch.setattr(distributed, "GRACE_S", 0.1)
    monkeypatch.setattr(distributed.os, "_exit", ended.append)
    others = [subprocess.Popen([sys.executable, "-c", "raise SystemExit(3)"])]
    done = distributed.threading.Event()
    watch = distributed.threading.Thread(target=distributed._watch, args=(others, done), daemon=True)
    watch.start()
    until = time.monotonic() + 30
    while not ended and time.monotonic() < until:
        time.sleep(0.05)
    done.set()
    watch.join()
    assert ended[0] == 1
    assert "error: process 1 of the run ended with exit code 3" in capsys.readouterr().err
