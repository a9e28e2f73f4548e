"""An interrupted and resumed run equals an uninterrupted one bit for bit; what cannot be resumed is told."""

import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from ctm_plugin import cli
from ctm_plugin.backbones.base import Backbone
from ctm_plugin.backbones.voxels import VoxelField
from ctm_plugin.color.ctm import CTM
from ctm_plugin.errors import CheckpointError, Interrupted
from ctm_plugin.rundir import CONFIG, LAST, METRICS, load_checkpoint
from ctm_plugin.train import resume, train

pytestmark = pytest.mark.usefixtures("offline")

# 12 steps of 2 batches: 4 coarse ones, then 8 fine ones that grow at 3 and 5 and renew the occupancy at 2 and 6.
# Learning rates are large enough for the coarse stage to find the ball.
STAGES = (
    "dataset.background=random_matched",
    "ctm.lr=0.01",
    "ctm.pretrain_steps=100",
    "ctm.lr_decay=0.5",
    "backbone.coarse=true",
    "backbone.coarse_steps=4",
    "backbone.steps=8",
    "backbone.grow=[3,5]",
    "backbone.occupancy_every=4",
    "backbone.lr_grid=4",
    "backbone.rays=128",
    "trainer.accumulate_grad_batches=2",
    "trainer.checkpoint_every=5",
)
STEPS, BATCHES = 12, 24
TIMES = ("train_seconds", "rays_per_second", "peak_memory_mb")


@pytest.fixture(scope="module")
def config(compose) -> dict[str, Any]:
    return compose(*STAGES)


@pytest.fixture(scope="module")
def whole(config, tmp_path_factory) -> Path:
    """The run that nothing interrupted."""
    run = tmp_path_factory.mktemp("whole") / "run"
    train(config, run)
    return run


@pytest.fixture
def finished(whole, tmp_path) -> Path:
    """A copy of it to break."""
    return Path(shutil.copytree(whole, tmp_path / "finished"))


@pytest.fixture
def ctrl_c(monkeypatch) -> Callable[..., None]:
    """Press Ctrl-C in the middle of the batches that a predicate tells."""
    step = Backbone.training_step

    def press(when: Callable[[int], bool], number: signal.Signals = signal.SIGINT) -> None:
        def training_step(self, *args):
            if when(self.batches_seen):
                signal.raise_signal(number)
            return step(self, *args)

        monkeypatch.setattr(Backbone, "training_step", training_step)

    return press


def checkpoint(run: Path) -> dict[str, Any]:
    return torch.load(run / LAST, weights_only=True)


def scores(run: Path) -> dict[str, Any]:
    return {key: value for key, value in json.loads((run / METRICS).read_text()).items() if key not in TIMES}


def differing(a: Any, b: Any, key: str = "") -> Iterator[str]:
    """Where two nests of containers and tensors are not equal bit for bit."""
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        if a.dtype != b.dtype or not torch.equal(a, b):
            yield key
    elif isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys():
        for name in a:
            yield from differing(a[name], b[name], f"{key}/{name}")
    elif isinstance(a, (list, tuple)) and isinstance(b, (list, tuple)) and len(a) == len(b):
        for index, (x, y) in enumerate(zip(a, b, strict=True)):
            yield from differing(x, y, f"{key}/{index}")
    elif type(a) is not type(b) or a != b:
        yield key


def same(run: Path, whole: Path) -> None:
    """Weights, both optimizers, stage and scores are equal."""
    left, right = checkpoint(run), checkpoint(whole)
    parts = ("state_dict", "optimizer_states", "batches_seen", "global_step", "dvgo", "config")
    assert list(differing({k: left[k] for k in parts}, {k: right[k] for k in parts})) == []
    assert scores(run) == scores(whole)


def test_the_run_has_all_that_can_go_wrong(whole):
    saved = checkpoint(whole)
    assert (saved["global_step"], saved["batches_seen"]) == (STEPS, BATCHES)
    assert (saved["dvgo"]["stage"], saved["dvgo"]["grown"]) == ("fine", 2)
    assert sorted(saved["optimizer_states"][0]) == ["ctm", "grids", "mlp"]
    # The coarse stage found the ball and the free space round it.
    box = saved["dvgo"]["box"]
    assert float((box[1] - box[0]).max()) < 3
    assert 0.1 < saved["state_dict"]["field.occupancy"].float().mean() < 0.9


@pytest.mark.parametrize("batch", [0, 1, 7, 8, 14, 15, 17, 21, 23])
def test_interrupted_anywhere(whole, config, tmp_path, ctrl_c, batch):
    ctrl_c(lambda seen: seen == batch)
    run = tmp_path / "run"
    with pytest.raises(Interrupted, match=rf"stopped after step {batch // 2 + 1}; go on with: .* resume={run}$"):
        train(config, run)
    # Saved between optimizer steps, though the signal came in the first batch of two.
    assert checkpoint(run)["batches_seen"] == 2 * (batch // 2 + 1)
    assert not (run / METRICS).exists()
    ctrl_c(lambda seen: False)
    resume(run)
    same(run, whole)


def test_interrupted_in_every_step(whole, config, tmp_path, ctrl_c):
    ctrl_c(lambda seen: seen % 2 == 0)
    run = tmp_path / "run"
    with pytest.raises(Interrupted):
        train(config, run)
    for step in range(2, STEPS + 1):
        with pytest.raises(Interrupted, match=f"after step {step};"):
            resume(run)
    resume(run)
    same(run, whole)


def test_interrupted_between_growth_and_renewal_of_the_occupancy(compose, tmp_path, ctrl_c, monkeypatch):
    def hits(self, rays, near, far):
        """Stands in for what hardly changes on a grid so small: another grid, other rays."""
        return torch.arange(len(rays.origins)) % 7 != self.occupancy.sum() % 7

    monkeypatch.setattr(VoxelField, "hits", hits)
    config = compose(*STAGES, "backbone.lr_grid=1", "backbone.threshold=0.001", "backbone.occupancy_every=100")
    train(config, tmp_path / "whole")
    ctrl_c(lambda seen: seen == 18)
    with pytest.raises(Interrupted):
        train(config, tmp_path / "run")
    assert not checkpoint(tmp_path / "run")["state_dict"]["field.occupancy"].all()
    ctrl_c(lambda seen: False)
    resume(tmp_path / "run")
    same(tmp_path / "run", tmp_path / "whole")
