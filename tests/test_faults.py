"""What befalls a run from outside: kills, a full disk, a second process, a cluster that wants its machine back."""

import random
import resource
import signal

import pytest
import torch
from faults import ARGUMENTS, Killer, checkpoint, differences
from forked import Command

from ctm_plugin import cli
from ctm_plugin.backbones.base import Backbone
from ctm_plugin.backbones.dvgo import DVGO
from ctm_plugin.errors import CheckpointError
from ctm_plugin.runs.rundir import CONFIG, DAMAGED, LAST, METRICS, PREVIOUS, locked, save_config
from ctm_plugin.runs.train import resume, train

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def config(composed):
    return composed(*ARGUMENTS)


def test_killed_at_random_moments(config, tmp_path):
    killer = Killer(config, tmp_path)
    assert differences(tmp_path / "again", killer.whole) == []
    generator = random.Random(1)
    steps = []
    for index, checkpoints in enumerate((0, 2, 7, 12)):
        step, different = killer.kill(f"run{index}", generator.random(), checkpoints)
        assert different == []
        steps.append(step)
    assert any(0 < step < 20 for step in steps)  # some while it trained


def test_killed_while_the_new_checkpoint_takes_its_place(finished, whole):
    steps = [torch.load(finished / name, weights_only=True)["global_step"] for name in (PREVIOUS, LAST)]
    assert steps == [19, 20]
    (finished / LAST).unlink()  # the last one is put aside, the new one not there yet
    (finished / METRICS).unlink()
    left = finished / "checkpoints" / ".last.ckpt.12345"
    left.write_bytes(b"half")
    resume(finished)
    assert differences(finished, whole) == []
    assert not left.exists()


@pytest.mark.parametrize("damage", ["truncated", "flipped"])
def test_a_damaged_checkpoint_is_told_and_the_one_before_offered(finished, whole, capsys, damage):
    content = bytearray((finished / LAST).read_bytes())
    if damage == "flipped":
        content[len(content) // 2] ^= 1
    else:
        del content[len(content) // 2 :]
    (finished / LAST).write_bytes(content)
    assert cli.main([f"resume={finished}"]) == 1
    error = capsys.readouterr().err
    assert f"{finished / LAST}: found an unreadable file" in error
    command = f"python -m ctm_plugin resume={finished / PREVIOUS}"
    assert command in error
    assert cli.main([command.split()[-1]]) == 0
    assert differences(finished, whole) == []
    assert (finished / DAMAGED).read_bytes() == bytes(content)


def test_what_cannot_be_gone_back_to(finished, capsys):
    other = finished / "checkpoints" / "other.ckpt"
    other.write_bytes((finished / LAST).read_bytes())
    for name in (LAST, PREVIOUS):
        (finished / name).write_bytes(b"PK")
    assert cli.main([f"resume={other}"]) == 1
    assert "found another file, expected a run directory, or its checkpoints/previous.ckpt" in capsys.readouterr().err
    assert cli.main([f"resume={finished / PREVIOUS}"]) == 1
    error = capsys.readouterr().err
    assert "previous.ckpt: found an unreadable file" in error
    assert "the one before" not in error
    assert (finished / LAST).read_bytes() == (finished / PREVIOUS).read_bytes() == b"PK"


def test_a_full_disk(config, whole, tmp_path, monkeypatch, capsys):
    """No file may grow beyond what is written in the first steps: the disk is full from then on."""
    run = tmp_path / "run"
    step = Backbone.training_step
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def training_step(self, *args):
        if self.batches_seen == 5:
            resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
        return step(self, *args)

    monkeypatch.setattr(Backbone, "training_step", training_step)
    try:
        with pytest.raises(CheckpointError, match=r"last.ckpt: found nothing that can be written") as error:
            train(config, run)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert f"expected room for a checkpoint; last good one kept: {run / LAST}" in str(error.value)
    assert checkpoint(run)["global_step"] == 5
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == ["last.ckpt", "previous.ckpt"]
    monkeypatch.setattr(Backbone, "training_step", step)
    resume(run)
    assert differences(run, whole) == []


def test_a_second_process_is_refused(finished):
    with locked(finished):
        second = Command(f"resume={finished}", told=finished.with_name("told"))
        _, error = second.communicate()
        assert second.returncode == 1
        assert f"{finished}: found another process at work on it" in error
        assert "Traceback" not in error
    resume(finished)


def test_two_new_runs_in_one_place(config, tmp_path):
    save_config(tmp_path / "run", config)
    with pytest.raises(CheckpointError, match="a run that is there already"):
        save_config(tmp_path / "run", config)
    assert [path.name for path in (tmp_path / "run").iterdir()] == [CONFIG]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 75), (signal.SIGINT, 130)])
def test_exit_codes(tmp_path, ctrl_c, number, code):
    """After SIGTERM, as clusters send it before they take a machine back, the exit code asks for another try."""
    ctrl_c(lambda seen: seen == 3, number)
    run = tmp_path / "run"
    assert cli.main([*ARGUMENTS, f"hydra.run.dir={run}"]) == code
    assert checkpoint(run)["global_step"] == 4
    assert cli.main(["-m", *ARGUMENTS, "seed=0,1", f"hydra.sweep.dir={tmp_path / 'sweep'}"]) == code


def test_sigterm_while_scoring(whole, tmp_path, monkeypatch):
    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(DVGO, "render_view", lambda *_: signal.raise_signal(signal.SIGTERM))
        assert cli.main([*ARGUMENTS, f"hydra.run.dir={run}"]) == 75
    resume(run)
    assert differences(run, whole) == []


def test_four_runs_at_once(tmp_path):
    """They share a data set and the folder for their output."""
    sizes = ("backbone.coarse=false", "backbone.steps_alone=2", "backbone.grow=[]", "ctm=off", "dataset.skip=20")
    arguments = ("trainer=smoke", "dataset.downscale=8", *sizes)
    processes = [Command(*arguments, told=tmp_path / f"told{number}", folder=tmp_path) for number in range(4)]
    said = [process.communicate() for process in processes]
    assert [process.returncode for process in processes] == [0] * 4, said
    assert len(list(tmp_path.glob(f"runs/*/{METRICS}"))) == 4
