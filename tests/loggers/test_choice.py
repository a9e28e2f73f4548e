"""Loggers and callbacks out of the configuration: ours, another package's, and none."""

import json
import sys
from pathlib import Path

import pytest
import torch
from lightning.pytorch.loggers import wandb
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.cli import main
from ctm_plugin.errors import CheckpointError, ConfigError, CTMError
from ctm_plugin.loggers.services import TensorBoard, kept_id
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.evaluate import evaluate
from ctm_plugin.runs.rundir import LAST, METRICS, load_config
from ctm_plugin.runs.train import resume, train
from ctm_plugin.settings.registry import LOGGERS

SMALL = ("backbone.coarse=false", "backbone.steps_alone=6", "backbone.grow=[]", "dataset.exposure=0.1", "ctm=off")
EVERY = ("trainer.log_every=1", "trainer.image_every=2", "trainer.checkpoint_every=3")


@pytest.fixture
def die(monkeypatch):
    """``die(step, *arguments)``: a run that is killed in a step."""
    step = Backbone.training_step

    def killed(config, run: Path, at: int) -> None:
        def training_step(self, *args):
            if self.batches_seen == at:
                for logger in self.trainer.loggers:
                    logger.save()
                raise RuntimeError("killed")
            return step(self, *args)

        with monkeypatch.context() as patch:
            patch.setattr(Backbone, "training_step", training_step)
            with pytest.raises(RuntimeError, match="killed"):
                train(config, run)

    return killed


def test_a_bug_in_a_logger_is_shown(tmp_path):
    class Broken(TensorBoard):
        @property
        def experiment(self):
            raise AttributeError("no such field")

    with pytest.raises(AttributeError, match="no such field"):
        Broken(TensorBoard.Config(), tmp_path, 0).open()


# Another package's


def notes(path: Path) -> list[tuple]:
    return [tuple(json.loads(line)) for line in path.read_text().splitlines()]


def test_a_logger_and_a_callback_of_another_package(installed, arguments, tmp_path):
    run = tmp_path / "run"
    theirs = ("logger=notes", "logger.file=mine.txt", "callbacks=count", "callbacks.count.by=2")
    assert main([*arguments, *SMALL, *EVERY, *theirs, "callbacks.progress=null", f"hydra.run.dir={run}"]) == 0
    assert {name for name, node in load_config(run)["callbacks"].items() if node is not None} == {"dashboard", "count"}
    told = notes(run / "mine.txt")
    curves = [content for kind, _, _, content in told if kind == "curves"]
    assert [each["loss/total"] > 0 for each in curves if "loss/total" in each] == [True] * 6
    assert [each["theirs/batches"] for each in curves if "theirs/batches" in each] == [2, 4, 6, 8, 10, 12]
    assert [step for kind, step, _, _ in told if kind == "pictures"] == [0, 2, 4, 6]
    assert all(shape[-1] == 3 for kind, _, _, content in told if kind == "pictures" for shape in content.values())
    assert {len(content) for kind, _, _, content in told if kind == "histograms"} == {6}
    assert curves[-1]["final/psnr"] == json.loads((run / METRICS).read_text())["psnr"]
    assert [content["backbone"] for kind, _, _, content in told if kind == "settings"] == ["dvgo"]
    assert not (run / "tensorboard").exists()


def test_what_another_package_keeps_outlives_an_interruption(installed, compose, die, tmp_path, monkeypatch):
    config, run, closed = compose(*SMALL, *EVERY, "+callbacks.count={}"), tmp_path / "run", []
    config["logger"] = {"name": "notes"}
    with monkeypatch.context() as patch:
        patch.setattr(LOGGERS.get("notes"), "close", lambda self: closed.append(self))
        die(config, run, 4)
    assert len(closed) == 1  # a failed run is no part of the next
    resume(run)
    assert torch.load(run / LAST, weights_only=True)["callbacks"]["Count"] == {"batches": 6}
    assert {began for _, _, began, _ in notes(run / "notes.txt")} == {0, 3}
    monkeypatch.setattr(sys, "path", [path for path in sys.path if not path.endswith("outside")])
    evaluate(run)  # a run is scored without their package
    with pytest.raises(CTMError, match="unknown logger 'notes'; known: tensorboard, wandb"):
        resume(run)


def test_what_a_callback_logs_is_there_once_at_the_steps_of_the_rest(installed, compose, die, tmp_path):
    config = compose(*SMALL, *EVERY, "+callbacks.count={}")
    die(config, tmp_path / "run", 4)
    resume(tmp_path / "run")
    told = curves(tmp_path / "run")
    assert [point for point in told if point[0] == "theirs/batches"] == [
        ("theirs/batches", step, step) for step in range(1, 7)
    ]
    assert not any(tag == "epoch" for tag, *_ in told)


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("+callbacks.nobody={}", "unknown callback 'nobody'; known: dashboard, progress"),
        ("callbacks.progress=3", "callbacks.progress: found 3, expected settings, or null for none of it"),
        ("trainer.image_every=0", "trainer.image_every: found 0, expected an integer >= 1 or null"),
        ("+callbacks.progress._target_=os.getcwd", "callbacks.progress._target_: found an unknown key, expected no"),
        ("logger=mine", "logger: found 'mine', expected one of none, tensorboard, wandb"),
        ("+logger.x=1", "logger.x: found an unknown key, expected no settings"),
    ],
)
def test_what_cannot_be_used_is_told_before_data_is_read(arguments, refused, argument, said, tmp_path, monkeypatch):
    monkeypatch.setattr("ctm_plugin.runs.assemble.load_scene", lambda *_: pytest.fail("data is read"))
    assert said in refused(*arguments, f"hydra.run.dir={tmp_path / 'run'}", argument)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("group", ["logger", "callbacks"])
def test_a_stranger_names_no_code(compose, tmp_path, group, monkeypatch):
    """A path of Python's in a run's configuration is an unknown name, and Hydra's own key an unknown key."""
    config = compose(*SMALL)
    monkeypatch.setattr("importlib.import_module", lambda name, *_: pytest.fail(f"{name} is imported"))
    for node in ({"name": "os:system"}, {"name": "os.system"}) if group == "logger" else ({"os:system": {}},):
        with pytest.raises(CTMError, match="unknown"):
            assemble({**config, group: node}, tmp_path)


# Ours

TIMED = ("speed/", "final/train_seconds", "final/rays_per_second", "final/peak_memory_mb")


def curves(run: Path) -> list[tuple[str, int, float]]:
    """Tag, step and value of all that TensorBoard has, but for what took time."""
    folder = run / "tensorboard"  # the row of scores has one of its own
    both = [EventAccumulator(str(each), {"scalars": 0}).Reload() for each in (folder, folder / "final")]
    told = [(tag, e.step, e.value) for events in both for tag in events.Tags()["scalars"] for e in events.Scalars(tag)]
    return [point for point in told if not point[0].startswith(TIMED)]


def test_no_logger_changes_nothing(compose, tmp_path):
    watched = train(compose(*SMALL, *EVERY), tmp_path / "run")
    assert train(compose(*SMALL, *EVERY, "logger=none"), tmp_path / "none")["psnr"] == watched["psnr"]
    folders = [{path.name for path in (tmp_path / name).iterdir()} for name in ("none", "run")]
    assert folders[1] - folders[0] == {"tensorboard"}


# Services, which need not be installed


@pytest.mark.parametrize("content", ["", "../../x", "a b", 65 * "a"])
def test_a_strangers_id(tmp_path, content):
    (tmp_path / "wandb.txt").write_text(content)
    with pytest.raises(CheckpointError, match=r"wandb\.txt: found '.*', expected a run's id"):
        kept_id(tmp_path / "wandb.txt")


def test_a_missing_package_is_told_with_its_extra(compose, tmp_path, monkeypatch):
    monkeypatch.setattr("ctm_plugin.runs.assemble.load_scene", lambda *_: pytest.fail("data is read"))
    monkeypatch.setattr(wandb, "_WANDB_AVAILABLE", False)
    with pytest.raises(ConfigError, match=r"logger: found 'wandb', expected .*pip install -e '.\[wandb\]'"):
        train(compose(*SMALL, "logger=wandb"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_service_that_cannot_be_reached_is_told_before_training(installed, compose, tmp_path, monkeypatch):
    config = compose(*SMALL)
    config["logger"] = {"name": "notes"}
    monkeypatch.setattr(LOGGERS.get("notes"), "open", lambda self: self.path.read_bytes())
    monkeypatch.setattr(Backbone, "training_step", lambda *_: pytest.fail("training"))
    with pytest.raises(CTMError, match=r"logger=notes: .*No such file"):
        train(config, tmp_path / "run")
