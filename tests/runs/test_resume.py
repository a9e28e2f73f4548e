"""An interrupted and resumed run equals an uninterrupted one bit for bit; what cannot be resumed is told."""

import pickle
import signal
import time
import zipfile
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from faults import checkpoint, differences, differing
from forked import Command
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutations import Payload
from omegaconf import OmegaConf

from ctm_plugin import __version__, cli
from ctm_plugin.backbones.dvgo import DVGO
from ctm_plugin.backbones.voxels import VoxelField
from ctm_plugin.color.ctm import CTM
from ctm_plugin.errors import CheckpointError, Interrupted
from ctm_plugin.runs import rundir
from ctm_plugin.runs.cameras import CAMERAS
from ctm_plugin.runs.data import DATA
from ctm_plugin.runs.evaluate import evaluate
from ctm_plugin.runs.rundir import CONFIG, LAST, METRICS, load_checkpoint, load_config
from ctm_plugin.runs.train import resume, train

# 12 steps of 2 batches: 4 coarse ones, then 8 fine ones that grow at 3 and 5 and renew the occupancy at 2 and 6.
# Learning rates are large enough for the coarse stage to find the ball.
STAGES = (
    "dataset.background=random_matched",
    "appearance=affine",
    "ctm.lr=0.01",
    "ctm.pretrain_steps=100",
    "ctm.lr_decay=0.5",
    "backbone.coarse=true",
    "backbone.coarse_steps=4",
    "backbone.steps=8",
    "backbone.grow=[3,5]",
    "backbone.restart=false",
    "backbone.shift_drop=0.5",
    "backbone.occupancy_first=2",
    "backbone.coarse_lr_grid=4",
    "backbone.lr_grid=4",
    "backbone.averaged=4",
    "backbone.rays=128",
    "trainer.accumulate_grad_batches=2",
    "trainer.checkpoint_every=5",
    "trainer.image_every=null",
)
STEPS, BATCHES = 12, 24


@pytest.fixture(scope="module")
def config(compose) -> dict[str, Any]:
    return compose(*STAGES)


@pytest.fixture(scope="module")
def whole(config, tmp_path_factory) -> Path:
    """The run that nothing interrupted."""
    run = tmp_path_factory.mktemp("whole") / "run"
    train(config, run)
    return run


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


@pytest.mark.parametrize("batch", [0, 7, 8, 15, 17, 23])
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
    def hits(self, rays):
        """Stands in for what hardly changes on a grid so small: another grid, other rays."""
        return torch.arange(len(rays.origins)) % 7 != self.occupancy.sum() % 7

    monkeypatch.setattr(VoxelField, "hits", hits)
    config = compose(
        *STAGES,
        "backbone.coarse_lr_grid=1",
        "backbone.lr_grid=1",
        "backbone.threshold=0.005",
        "backbone.occupancy_first=50",
    )
    train(config, tmp_path / "whole")
    ctrl_c(lambda seen: seen == 18)
    with pytest.raises(Interrupted):
        train(config, tmp_path / "run")
    assert not checkpoint(tmp_path / "run")["state_dict"]["field.occupancy"].all()
    ctrl_c(lambda seen: False)
    resume(tmp_path / "run")
    same(tmp_path / "run", tmp_path / "whole")


@pytest.fixture(scope="module")
def planes(compose, hall, tmp_path_factory) -> tuple[dict[str, Any], Path]:
    """Forward-facing, growth at 3 and 5, total variation of all voxels up to 4 and of those seen after; a whole run."""
    config = compose(
        "dataset=llff", f"dataset.root={hall}", "ctm.pretrain_steps=20", "backbone.steps_alone=9",
        "backbone.grow=[3,5]", "backbone.occupancy_first=2", "backbone.tv_dense_steps=4",
        "trainer.accumulate_grad_batches=2", "trainer.checkpoint_every=5", "trainer.image_every=null",
    )  # fmt: skip
    run = tmp_path_factory.mktemp("planes") / "whole"
    train(config, run)
    return config, run


@pytest.mark.parametrize("batch", [3, 9, 16])
def test_planes_interrupted_anywhere(planes, tmp_path, ctrl_c, batch):
    config, whole = planes
    ctrl_c(lambda seen: seen == batch)
    with pytest.raises(Interrupted):
        train(config, tmp_path / "run")
    ctrl_c(lambda seen: False)
    resume(tmp_path / "run")
    same(tmp_path / "run", whole)


def test_interrupted_in_pretraining_starts_again(whole, config, tmp_path, monkeypatch, capsys):
    loss = CTM.cycle_loss
    calls = 0

    def cycle_loss(self, *args):
        nonlocal calls
        calls += 1
        if calls == 50:
            signal.raise_signal(signal.SIGINT)
        return loss(self, *args)

    monkeypatch.setattr(CTM, "cycle_loss", cycle_loss)
    run = tmp_path / "run"
    with pytest.raises(Interrupted, match="stopped before the first step; go on with"):
        train(config, run)
    assert calls == 50
    assert {path.name for path in run.iterdir() if path.is_file()} == {CONFIG, DATA, CAMERAS}
    assert cli.main([f"resume={run}"]) == 0
    assert calls == 150
    same(run, whole)


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


@pytest.fixture(scope="module")
def nerf(compose, tmp_path_factory) -> tuple[dict[str, Any], Path]:
    """Batches from the middle of the pictures first, jittered samples, noise on the density; its whole run."""
    sizes = ("steps=10", "crop_steps=6", "density_noise=0.5", "lr=0.01")
    config = compose(
        "backbone=nerf", "color_space=log", "ctm.pretrain_steps=20", *(f"backbone.{size}" for size in sizes)
    )
    run = tmp_path_factory.mktemp("nerf") / "whole"
    train(config, run)
    return config, run


@pytest.mark.parametrize("batch", [0, 5, 9])
def test_nerf(nerf, tmp_path, ctrl_c, batch):
    config, whole = nerf
    ctrl_c(lambda seen: seen == batch)
    with pytest.raises(Interrupted, match=f"after step {batch + 1};"):
        train(config, tmp_path / "run")
    ctrl_c(lambda seen: False)
    resume(tmp_path / "run")
    same(tmp_path / "run", whole)


@pytest.fixture(scope="module")
def ngp(compose, tmp_path_factory) -> tuple[dict[str, Any], Path]:
    """Free space is looked for in steps 3, 5, 7 and 9, once each though a step has two batches; its whole run."""
    sizes = (
        "steps=10",
        "occupancy_first=3",
        "occupancy_every=2",
        "relative=true",
        "distortion=0.01",
        "averaged=8",
        "free_below=0.5",
    )
    config = compose(
        "backbone=ngp", "ctm.pretrain_steps=20", "trainer.accumulate_grad_batches=2",
        *(f"backbone.{size}" for size in sizes),
    )  # fmt: skip
    run = tmp_path_factory.mktemp("ngp") / "whole"
    train(config, run)
    return config, run


@pytest.mark.parametrize("batch", [0, 6, 13, 19])
def test_ngp(ngp, tmp_path, ctrl_c, batch):
    config, whole = ngp
    assert 0 < checkpoint(whole)["state_dict"]["field.occupancy"].float().mean() < 1
    ctrl_c(lambda seen: seen == batch)
    with pytest.raises(Interrupted, match=f"after step {batch // 2 + 1};"):
        train(config, tmp_path / "run")
    ctrl_c(lambda seen: False)
    resume(tmp_path / "run")
    same(tmp_path / "run", whole)


def test_ngp_whose_free_space_settles(compose, tmp_path, ctrl_c, monkeypatch):
    """In steps 5, 7 and 11, saved after 9."""
    monkeypatch.setattr("ctm_plugin.backbones.ngp.SETTLED", 1)
    sizes = ("steps=12", "occupancy_first=3", "occupancy_every=2", "free_for_good=0.06", "lr_grid=0.3")
    config = compose("backbone=ngp", "ctm=off", "dataset.background=white", *(f"backbone.{size}" for size in sizes))
    train(config, tmp_path / "whole")
    ctrl_c(lambda seen: seen == 8)
    with pytest.raises(Interrupted, match="after step 9;"):
        train(config, tmp_path / "run")
    ctrl_c(lambda seen: False)
    assert 0.01 < checkpoint(tmp_path / "run")["state_dict"]["field.allowed"].float().mean() < 0.99
    resume(tmp_path / "run")
    same(tmp_path / "run", tmp_path / "whole")


def test_sigterm_saves_too_and_handlers_are_put_back(config, tmp_path, ctrl_c):
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    ctrl_c(lambda seen: seen == 3, signal.SIGTERM)
    with pytest.raises(Interrupted, match="after step 2"):
        train(config, tmp_path)
    assert checkpoint(tmp_path)["global_step"] == 2
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_a_finished_run_is_scored_again_and_loses_nothing(whole, finished, capsys):
    (finished / "lit" / "r_0.png").unlink()
    assert cli.main([f"resume={finished}"]) == 0
    assert f"{finished}: finished, all 12 steps are done; it is scored again\n" in capsys.readouterr().err
    assert (finished / METRICS).read_text() == (whole / METRICS).read_text()  # times too
    assert (finished / LAST).read_bytes() == (whole / LAST).read_bytes()
    assert (finished / "lit" / "r_0.png").read_bytes() == (whole / "lit" / "r_0.png").read_bytes()


def test_a_new_run_in_its_place_is_refused(whole, config, finished, capsys):
    def files(run: Path) -> dict[str, bytes]:
        return {str(path.relative_to(run)): path.read_bytes() for path in run.rglob("*") if path.is_file()}

    with pytest.raises(
        CheckpointError, match=r"found a run that is there already, expected a new directory, or resume="
    ):
        train(config, finished)
    assert cli.main([f"hydra.run.dir={finished}", "trainer=smoke", "seed=3"]) == 1
    assert "a run that is there already" in capsys.readouterr().err
    assert files(finished) == files(whole)
    for name in (LAST, METRICS):  # interrupted before its first checkpoint, it is a run still
        (finished / name).unlink()
    with pytest.raises(CheckpointError, match="a run that is there already"):
        train(config, finished)


@pytest.mark.parametrize("spelling", ["resume={}", "+resume={}", "++resume={}"])
def test_spellings(finished, capsys, spelling):
    assert cli.main([spelling.format(finished)]) == 0
    assert f"written to {finished}" in capsys.readouterr().out


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
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ")
    assert message in captured.err


def test_resume_null_is_no_resume(compose):
    assert compose("resume=null")["resume"] is None


def refused(run: Path) -> str:
    """The one message with which both commands refuse a run."""
    with pytest.raises(CheckpointError) as caught:
        resume(run)
    with pytest.raises(CheckpointError) as again:
        evaluate(run)
    assert str(caught.value) == str(again.value)
    assert str(caught.value).startswith(str(run))
    return str(caught.value)


def test_a_checkpoint_of_another_configuration(finished):
    path = finished / CONFIG
    config = OmegaConf.load(path)
    config.ctm.weights.enc = 2.0
    config.seed = 1
    del config.backbone.planes
    OmegaConf.save(config, path)
    message = refused(finished)
    assert "found another configuration (differs in backbone.planes, ctm.weights.enc, seed)" in message


@pytest.mark.parametrize(
    ("version", "found"), [(None, "0.5 or older"), ("0.1.9", "'0.1.9'"), ("1", "'1'"), ([[0, 6]], "[[0, 6]]")]
)
def test_a_run_of_another_version(finished, version, found):
    config = OmegaConf.load(finished / CONFIG)
    config.version = version
    OmegaConf.save(config, finished / CONFIG)
    assert refused(finished).endswith(f": found a run of version {found}, expected one of this version, {__version__}")


def test_a_run_of_this_minor_version(finished, monkeypatch):
    monkeypatch.setattr(rundir, "__version__", ".".join([*__version__.split(".")[:2], "99"]))
    assert load_config(finished)["seed"] == 0


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "found nothing, expected a mapping"),
        ("[1, 2]", "found a list, expected a mapping"),
        (f"version: {__version__}\nseed: 0", "found nothing for dataset"),
        ("a: [", "found no readable YAML"),
        ("a: *b", "found no readable YAML"),
        ("!!python/object/apply:os.system [exit]", "found no readable YAML"),
        ("\x00\xff", "found no readable YAML"),
    ],
)
def test_a_broken_configuration(finished, content, message):
    (finished / CONFIG).write_bytes(content.encode("latin-1"))
    assert message in refused(finished)


@pytest.mark.parametrize("keep", [0, 1, 100, 5000, -1, -100])
def test_a_truncated_checkpoint(finished, keep):
    (finished / LAST).write_bytes((finished / LAST).read_bytes()[:keep])
    assert "last.ckpt: found an unreadable file" in refused(finished)


@given(st.binary(max_size=200))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
def test_a_checkpoint_of_random_bytes(finished, content):
    (finished / LAST).write_bytes(content)
    assert "last.ckpt: found an unreadable file" in refused(finished)


@given(st.integers(0, 2**31), st.integers(1, 255))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
def test_a_damaged_checkpoint_is_told_or_read_as_it_was(finished, whole, where, flip):
    """One byte of it changed: some bytes of an archive carry no information, all others are noticed."""
    content = bytearray((whole / LAST).read_bytes())
    content[where % len(content)] ^= flip
    (finished / LAST).write_bytes(content)
    config = load_config(finished)
    try:
        read = load_checkpoint(finished, config)
    except CheckpointError:
        return
    assert list(differing(read["state_dict"], checkpoint(whole)["state_dict"])) == []


@pytest.mark.parametrize("kind", ["pickle", "torch", "inside"])
def test_code_in_a_checkpoint_does_not_run(finished, tmp_path, kind):
    touched = tmp_path / "touched"
    saved = checkpoint(finished)
    if kind == "pickle":
        (finished / LAST).write_bytes(pickle.dumps(Payload(touched)))
    elif kind == "torch":
        torch.save(Payload(touched), finished / LAST)
    else:
        torch.save(saved | {"loops": Payload(touched)}, finished / LAST)
    with zipfile.ZipFile(finished / LAST) if kind != "pickle" else nullcontext():
        assert "last.ckpt: found an unreadable file" in refused(finished)
    assert not touched.exists()
    pickle.loads(pickle.dumps(Payload(touched)))
    assert touched.exists()  # it would have


@pytest.mark.parametrize("content", [[1], {"state_dict": {}}, {"config": {}, "batches_seen": 1}])
def test_a_checkpoint_of_another_program(finished, content):
    torch.save(content, finished / LAST)
    assert "found a file of another kind, expected a checkpoint of ctm_plugin" in refused(finished)


def test_a_checkpoint_of_another_model(finished):
    saved = checkpoint(finished)
    saved["state_dict"]["mlp.layers.0.weight"] = torch.zeros(1)
    torch.save(saved, finished / LAST)
    message = refused(finished)
    assert "found weights that do not fit" in message
    assert "mlp.layers.0.weight" in message


def test_ctrl_c_in_a_process(arguments, whole, tmp_path):
    """As a user does it: the signal from outside, the command that the message gives, the same end."""
    run = tmp_path / "my run"
    first = [*arguments, *STAGES, f"hydra.run.dir='{run}'", "backbone.steps=100000", "backbone.occupancy_first=50000"]
    process = Command(*first, told=tmp_path / "told")
    until = time.monotonic() + 120
    while not (run / LAST).exists() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    output, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert output == ""
    assert "Traceback" not in error
    steps = checkpoint(run)["global_step"]
    assert steps > 4
    assert error.splitlines()[-1] == f"stopped after step {steps}; go on with: python -m ctm_plugin resume='{run}'"
