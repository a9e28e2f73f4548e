"""An interrupted and resumed run equals an uninterrupted one bit for bit; what cannot be resumed is told."""

import signal
import time
from pathlib import Path
from typing import Any

import pytest
from faults import checkpoint, differences, differing
from forked import Command
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from ctm_plugin import __version__, cli
from ctm_plugin.backbones.dvgo import DVGO
from ctm_plugin.color.ctm import CTM
from ctm_plugin.errors import CheckpointError, Interrupted
from ctm_plugin.runs import rundir
from ctm_plugin.runs.cameras import CAMERAS_FILE
from ctm_plugin.runs.data import DATA_FILE
from ctm_plugin.runs.evaluate import evaluate
from ctm_plugin.runs.load import load_checkpoint
from ctm_plugin.runs.rundir import CONFIG, LAST, METRICS, load_config
from ctm_plugin.runs.train import resume, train

# 12 steps of 2 batches: 4 coarse ones, then 8 fine ones that grow at 3 and 5 and renew the occupancy at 2 and 6.
# Learning rates are large enough for the coarse stage to find the ball.
STAGES = (
    "dataset.background=random_matched", "appearance=exposure", "ctm.lr=0.01", "ctm.pretrain_steps=100",
    "ctm.lr_decay=0.5", "backbone.coarse=true", "backbone.coarse_steps=4", "backbone.steps=8", "backbone.grow=[3,5]",
    "backbone.restart=false", "backbone.shift_drop=0.5", "backbone.occupancy_first=2", "backbone.coarse_lr_grid=8",
    "backbone.lr_grid=4", "backbone.averaged=4", "backbone.rays=128", "trainer.accumulate_grad_batches=2",
    "trainer.checkpoint_every=5", "trainer.image_every=null",
)  # fmt: skip
STEPS, BATCHES = 12, 24
OTHERS = {
    # Forward-facing, growth at 3 and 5, total variation of all voxels up to 4 and of those seen after.
    "planes": (
        "dataset=llff", "ctm.pretrain_steps=20", "backbone.steps_alone=9", "backbone.grow=[3,5]",
        "backbone.occupancy_first=2", "backbone.tv_dense_steps=4", "trainer.accumulate_grad_batches=2",
        "trainer.checkpoint_every=5", "trainer.image_every=null",
    ),
    # Batches from the middle of the pictures first, jittered samples, noise on the density.
    "nerf": (
        "backbone=nerf", "color_space=log", "ctm.pretrain_steps=20", "backbone.steps=10", "backbone.crop_steps=6",
        "backbone.density_noise=0.5", "backbone.lr=0.01",
    ),
    # Free space is looked for in steps 3, 5, 7 and 9, once each though a step has two batches.
    "ngp": (
        "backbone=ngp", "ctm.pretrain_steps=20", "trainer.accumulate_grad_batches=2", "backbone.steps=10",
        "backbone.occupancy_first=3", "backbone.occupancy_every=2", "backbone.relative=true",
        "backbone.distortion=0.01", "backbone.averaged=8", "backbone.free_below=0.5",
    ),
    # It settles in steps 5, 7 and 11, saved after 9.
    "settled": (
        "backbone=ngp", "ctm=off", "dataset.background=white", "backbone.steps=12", "backbone.occupancy_first=3",
        "backbone.occupancy_every=2", "backbone.free_for_good=0.06", "backbone.lr_grid=0.3",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def config(compose) -> dict[str, Any]:
    return compose(*STAGES)


def same(run: Path, whole: Path) -> None:
    """Weights, both optimizers, stage and scores are equal."""
    assert differences(run, whole) == []


def test_the_run_has_all_that_can_go_wrong(whole):
    saved = checkpoint(whole)
    assert (saved["global_step"], saved["batches_seen"]) == (STEPS, BATCHES)
    assert (saved["dvgo"]["stage"], saved["dvgo"]["grown"], saved["dvgo"]["dropped"]) == ("fine", 2, 1.0)
    assert sorted(saved["optimizer_states"][0]) == ["appearance", "ctm", "grids", "mlp"]
    assert "mean_field.density" in saved["state_dict"]
    # The coarse stage found the ball and the free space round it.
    box = saved["dvgo"]["box"]
    assert float((box[1] - box[0]).max()) < 3
    assert 0.1 < saved["state_dict"]["field.occupancy"].float().mean() < 0.9


@pytest.mark.parametrize("batch", [23, pytest.param(7, marks=pytest.mark.slow)])
def test_interrupted_in_a_second_batch(whole, config, tmp_path, ctrl_c, batch):
    ctrl_c(lambda seen: seen == batch)
    run = tmp_path / "run"
    with pytest.raises(Interrupted, match=rf"stopped after step {batch // 2 + 1}; go on with: .* resume={run}$"):
        train(config, run)
    assert not (run / METRICS).exists()
    ctrl_c(lambda seen: False)
    resume(run)
    same(run, whole)


@pytest.mark.slow
def test_interrupted_in_every_step(whole, config, tmp_path, ctrl_c):
    ctrl_c(lambda seen: seen % 2 == 0)
    run = tmp_path / "run"
    with pytest.raises(Interrupted):
        train(config, run)
    for step in range(2, STEPS + 1):
        # Saved between optimizer steps, though the signal came in the first batch of two.
        assert checkpoint(run)["batches_seen"] == 2 * (step - 1)
        with pytest.raises(Interrupted, match=f"after step {step};"):
            resume(run)
    resume(run)
    same(run, whole)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "batch"), [("planes", 9), ("nerf", 5), ("ngp", 13), ("settled", 8)])
def test_other_fields(compose, hall, tmp_path, ctrl_c, monkeypatch, kind, batch):
    monkeypatch.setattr("ctm_plugin.backbones.ngp.SETTLING_UPDATES", 1)
    config = compose(*OTHERS[kind], *((f"dataset.root={hall}",) if kind == "planes" else ()))
    train(config, tmp_path / "whole")
    ctrl_c(lambda seen: seen == batch)
    with pytest.raises(Interrupted):
        train(config, tmp_path / "run")
    ctrl_c(lambda seen: False)
    free = {"ngp": "field.occupancy", "settled": "field.allowed"}.get(kind)
    assert free is None or 0.01 < checkpoint(tmp_path / "run")["state_dict"][free].float().mean() < 1
    resume(tmp_path / "run")
    same(tmp_path / "run", tmp_path / "whole")


@pytest.mark.slow
def test_interrupted_in_pretraining_starts_again(whole, config, tmp_path, monkeypatch):
    loss, calls = CTM.cycle_loss, []

    def cycle_loss(self, *args):
        calls.append(self)
        if len(calls) == 50:
            signal.raise_signal(signal.SIGINT)
        return loss(self, *args)

    monkeypatch.setattr(CTM, "cycle_loss", cycle_loss)
    run = tmp_path / "run"
    with pytest.raises(Interrupted, match="stopped before the first step; go on with"):
        train(config, run)
    assert {path.name for path in run.iterdir() if path.is_file()} == {CONFIG, DATA_FILE, CAMERAS_FILE}
    assert cli.main([f"+resume={run}"]) == 0
    assert len(calls) == 150
    same(run, whole)


@pytest.mark.slow
def test_interrupted_while_scoring(whole, config, tmp_path, monkeypatch):
    def render_view(self, *args):
        raise KeyboardInterrupt

    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(DVGO, "render_view", render_view)
        with pytest.raises(Interrupted, match="stopped while scoring; go on with"):
            train(config, run)
    resume(run)
    same(run, whole)


def test_a_finished_run_is_scored_again_and_loses_nothing(whole, finished, capsys):
    (finished / "lit" / "r_0.png").unlink()
    assert cli.main([f"++resume={finished}"]) == 0
    assert f"{finished}: finished, all 12 steps are done; it is scored again\n" in capsys.readouterr().err
    for file in (METRICS, LAST, "lit/r_0.png"):  # times too
        assert (finished / file).read_bytes() == (whole / file).read_bytes()


def test_a_new_run_in_its_place_is_refused(whole, config, finished, capsys):
    def files(run: Path) -> dict[str, bytes]:
        return {str(path.relative_to(run)): path.read_bytes() for path in run.rglob("*") if path.is_file()}

    assert cli.main([f"hydra.run.dir={finished}", "trainer=smoke", "seed=3"]) == 1
    assert "a run that is there already, expected a new directory, or resume=" in capsys.readouterr().err
    assert files(finished) == files(whole)
    for name in (LAST, METRICS):  # interrupted before its first checkpoint, it is a run still
        (finished / name).unlink()
    with pytest.raises(CheckpointError, match="a run that is there already"):
        train(config, finished)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (["resume={}", "seed=1"], "resume: found seed=1 with it, expected nothing"),
        (["-m", "+resume={}"], "resume: found -m with it"),
        (["backbone=dvgo", "resume={}", "ctm=on"], "found backbone=dvgo ctm=on with it"),
        (["resume={}", "resume={}"], "found 2 runs, expected one"),
        (["resume={}/nowhere"], "nowhere: found no such directory, expected a run directory"),
        (["resume={}/checkpoints"], f"checkpoints: found no {CONFIG}, expected a run directory"),
        (["resume="], f"found no {CONFIG}, expected a run directory"),
    ],
)
def test_what_cannot_be_resumed_is_told(whole, tmp_path, monkeypatch, capsys, line, message):
    monkeypatch.chdir(tmp_path)
    assert cli.main([argument.format(whole) for argument in line]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error


def refused(run: Path) -> str:
    """The one message with which both commands refuse a run."""
    said = []
    for command in (resume, evaluate):
        with pytest.raises(CheckpointError) as caught:
            command(run)
        said.append(str(caught.value))
    assert said[0] == said[1]
    assert said[0].startswith(str(run))
    return said[0]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"ctm.weights.enc": 2.0, "seed": 1, "backbone.planes": 5},
            "found another configuration (differs in backbone.planes, ctm.weights.enc, seed)",
        ),
        ({"version": None}, f"found a run of version 0.5 or older, expected one of this version, {__version__}"),
        ({"version": "0.1.9"}, "found a run of version '0.1.9'"),
        ({"version": [[0, 6]]}, "found a run of version [[0, 6]]"),
    ],
)
def test_another_configuration_or_version(finished, keys, message):
    config = OmegaConf.load(finished / CONFIG)
    for key, value in keys.items():
        OmegaConf.update(config, key, value)
    OmegaConf.save(config, finished / CONFIG)
    assert message in refused(finished)


def test_a_run_of_this_minor_version(finished, monkeypatch):
    monkeypatch.setattr(rundir, "__version__", ".".join([*__version__.split(".")[:2], "99"]))
    assert load_config(finished)["seed"] == 0


@pytest.mark.parametrize("keep", [0, 100, -1])
def test_a_truncated_checkpoint(finished, keep):
    (finished / LAST).write_bytes((finished / LAST).read_bytes()[:keep])
    assert "last.ckpt: found an unreadable file" in refused(finished)


@given(st.integers(0, 2**31), st.integers(1, 255))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
def test_a_damaged_checkpoint_is_told_or_read_as_it_was(finished, whole, where, flip):
    """One byte of it changed: some bytes of an archive carry no information, all others are noticed."""
    content = bytearray((whole / LAST).read_bytes())
    content[where % len(content)] ^= flip
    (finished / LAST).write_bytes(content)
    try:
        read = load_checkpoint(finished, load_config(finished))
    except CheckpointError:
        return
    assert list(differing(read["state_dict"], checkpoint(whole)["state_dict"])) == []


@pytest.mark.slow
def test_ctrl_c_in_a_process(arguments, tmp_path):
    """As a user does it: the signal from outside, the command that the message gives."""
    run = tmp_path / "my run"
    sizes = ("backbone.steps_alone=100000", "backbone.coarse=false", "trainer.checkpoint_every=5", "ctm=off")
    process = Command(*arguments, *sizes, f"hydra.run.dir='{run}'", told=tmp_path / "told")
    until = time.monotonic() + 120
    while not (run / LAST).exists() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    output, error = process.communicate(timeout=60)
    assert (process.returncode, output) == (130, "")
    assert "Traceback" not in error
    steps = checkpoint(run)["global_step"]
    assert steps > 4
    assert error.splitlines()[-1] == f"stopped after step {steps}; go on with: python -m ctm_plugin resume='{run}'"
