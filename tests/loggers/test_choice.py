"""Loggers and callbacks out of the configuration: ours, another package's, and none."""

import csv
import json
import shutil
import sys
from contextlib import suppress
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
from lightning.pytorch.loggers import mlflow, wandb
from omegaconf import OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.cli import main
from ctm_plugin.errors import CheckpointError, ConfigError, CTMError
from ctm_plugin.runs.assemble import assemble, loggers
from ctm_plugin.runs.evaluate import evaluate
from ctm_plugin.runs.rundir import CONFIG, LAST, METRICS, load_config
from ctm_plugin.runs.train import resume, train

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


# Another package's


def notes(path: Path) -> list[tuple]:
    return [tuple(json.loads(line)) for line in path.read_text().splitlines()]


@pytest.fixture
def command(arguments, tmp_path):
    """``command(*more)``: a run by the command line; its directory."""

    def go(*more: str) -> Path:
        assert main([*arguments, *SMALL, *EVERY, f"hydra.run.dir={tmp_path / 'run'}", *more]) == 0
        return tmp_path / "run"

    return go


def test_a_logger_and_a_callback_of_another_package(installed, command):
    run = command("logger=notes", "logger.file=mine.txt", "callbacks=count", "callbacks.count.by=2")
    assert load_config(run)["callbacks"].keys() == {"progress", "dashboard", "film", "count"}
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


def test_a_callback_by_its_key_alone_in_the_place_of_another(installed, command):
    run = command("logger=none", "+callbacks.count={batches: 3}", "~callbacks.film", "callbacks.progress=null")
    named = load_config(run)["callbacks"]
    assert {name for name, node in named.items() if node is not None} == {"dashboard", "count"}
    state = torch.load(run / LAST, weights_only=True)["callbacks"]
    assert state["Count"] == {"batches": 3 + 6}


def test_what_another_package_keeps_outlives_an_interruption(installed, compose, die, tmp_path):
    config = compose(*SMALL, *EVERY, "+callbacks.count={}")
    config["logger"] = {"name": "notes"}
    die(config, tmp_path / "run", 4)
    resume(tmp_path / "run")
    state = torch.load(tmp_path / "run" / LAST, weights_only=True)["callbacks"]
    assert state["Count"] == {"batches": 6}
    assert {began for _, _, began, _ in notes(tmp_path / "run" / "notes.txt")} == {0, 3}


@pytest.mark.parametrize("stopped", [4, 5])
def test_what_a_callback_logs_is_there_once_at_the_steps_of_the_rest(installed, compose, die, tmp_path, stopped):
    config = compose(*SMALL, *EVERY, "logger=csv", "+callbacks.count={}")
    die(config, tmp_path / "run", stopped)
    resume(tmp_path / "run")
    counts = [(row["step"], float(row["theirs/batches"])) for row in rows(tmp_path / "run") if "theirs/batches" in row]
    assert counts == [(str(step), step) for step in range(1, 7)]
    assert not any("epoch" in row for row in rows(tmp_path / "run"))


def test_a_run_is_scored_without_their_package(installed, compose, tmp_path, monkeypatch):
    config = compose(*SMALL, *EVERY, "+callbacks.count={}")
    config["logger"] = {"name": "notes"}
    train(config, tmp_path / "run")
    monkeypatch.setattr(sys, "path", [path for path in sys.path if not path.endswith("outside")])
    evaluate(tmp_path / "run")
    with pytest.raises(CTMError, match="unknown logger 'notes'; known: csv, mlflow, tensorboard, wandb"):
        resume(tmp_path / "run")


def test_theirs_are_listed(installed, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["list"]) == 0
    shown = [line.split() for line in capsys.readouterr().out.splitlines()]
    for name in ("notes", "count"):
        assert any(name in line[:2] and line[-2:] == ["from", "outside-package"] for line in shown)


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("+callbacks.nobody={}", "unknown callback 'nobody'; known: dashboard, film, progress"),
        ("callbacks.film=3", "callbacks.film: found 3, expected settings, or null for none of it"),
        ("callbacks.film.frames=0", "callbacks.film.frames: found 0, expected an integer >= 1"),
        ("callbacks.dashboard.image_every=0", "callbacks.dashboard.image_every: found 0, expected an integer >= 1"),
        ("trainer.image_every=0", "trainer.image_every: found 0, expected an integer >= 1, or null"),
        ("callbacks.progress.refresh_seconds=0.0", "callbacks.progress.refresh_seconds: found 0.0, expected a number"),
        (
            "+callbacks.film._target_=os.getcwd",
            "callbacks.film._target_: found 'an unknown key', expected one of frames",
        ),
        ("logger=mine", "logger: found 'mine', expected one of csv, mlflow, none, tensorboard, wandb"),
        ("+logger.x=1", "logger.x: found 'an unknown key', expected no settings"),
    ],
)
def test_what_cannot_be_used_is_told_before_data_is_read(arguments, capsys, argument, said, tmp_path, monkeypatch):
    monkeypatch.setattr("ctm_plugin.runs.assemble.load_scene", lambda config: pytest.fail("data is read"))
    assert main([*arguments, f"hydra.run.dir={tmp_path / 'run'}", argument]) == 1
    assert said in capsys.readouterr().err
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


def test_none(compose, tmp_path):
    run = tmp_path / "run"
    quiet = train(compose(*SMALL, *EVERY, "logger=none"), run)
    files = {CONFIG, "data.json", "cameras.json", METRICS, "checkpoints"}
    assert {path.name for path in run.iterdir()} == files | {"lit", "photo", "dark", "depth", "latent"}
    assert resume(run)["psnr"] == quiet["psnr"] == train(compose(*SMALL, *EVERY), tmp_path / "watched")["psnr"]


def rows(run: Path) -> list[dict[str, str]]:
    """Of the table, but for what took time."""
    with (run / "csv" / "metrics.csv").open() as file:
        found = list(csv.DictReader(file))
    timed = ("speed/", "final/train_seconds", "final/rays_per_second", "final/peak_memory_mb")
    return [
        {name: value for name, value in sorted(row.items()) if value and not name.startswith(timed)} for row in found
    ]


@pytest.fixture(scope="module")
def table(compose, tmp_path_factory) -> tuple[dict, Path]:
    """A configuration with a table of curves, and its run that nothing interrupted."""
    config, run = compose(*SMALL, *EVERY, "logger=csv"), tmp_path_factory.mktemp("whole") / "run"
    train(config, run)
    return config, run


def test_csv(table):
    config, run = table
    curves = [row for row in rows(run) if "loss/total" in row]
    assert [int(row["step"]) for row in curves] == [1, 2, 3, 4, 5, 6]
    assert [int(row["step"]) for row in rows(run) if "psnr/test_view" in row] == [0, 2, 4, 6]
    last = rows(run)[-1]
    assert (last["step"], float(last["final/psnr"])) == ("7", json.loads((run / METRICS).read_text())["psnr"])
    settings = OmegaConf.load(run / "csv" / "hparams.yaml")
    assert (settings["backbone"], settings["seed"]) == ("dvgo", config["seed"])


def test_csv_is_what_tensorboard_has(table, compose, tmp_path):
    train(compose(*SMALL, *EVERY), tmp_path / "run")
    folder = tmp_path / "run" / "tensorboard"  # the row of scores has one of its own
    both = [EventAccumulator(str(each), {"scalars": 0}).Reload() for each in (folder, folder / "final")]
    written = {(name, int(row["step"])): float(row[name]) for row in rows(table[1]) for name in row if name != "step"}
    told = {
        (tag, event.step): event.value
        for events in both
        for tag in events.Tags()["scalars"]
        for event in events.Scalars(tag)
    }
    timed = ("speed/", "final/train_seconds", "final/rays_per_second", "final/peak_memory_mb")
    assert written == pytest.approx({key: v for key, v in told.items() if not key[0].startswith(timed)})


@pytest.mark.parametrize("stopped", [1, 4, 5], ids=lambda step: f"in_step_{step}")
def test_a_resumed_table_has_every_row_once(table, die, tmp_path, stopped):
    config, whole = table
    die(config, tmp_path / "run", stopped)
    assert max(int(row["step"]) for row in rows(tmp_path / "run")) == stopped
    resume(tmp_path / "run")
    assert rows(tmp_path / "run") == rows(whole)
    resume(tmp_path / "run")  # scored again
    assert rows(tmp_path / "run") == rows(whole)


@pytest.mark.parametrize(
    "content", ["", "a,b\n1,2\n", "step\nx\n", "step,a\n1,2,3\n", "step\n1\n" + "9" * 5000, "\xff"]
)
def test_a_strangers_table(table, tmp_path, content):
    run = Path(shutil.copytree(table[1], tmp_path / "run"))
    (run / "csv" / "metrics.csv").write_bytes(content.encode("latin-1"))
    with pytest.raises(
        CheckpointError, match=r"metrics.csv: found no readable curves \(\w+\), expected rows with a step"
    ):
        resume(run)


# Services that are not installed here


@pytest.mark.parametrize("content", ["", "../../x", "a b", 65 * "a"])
@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_a_strangers_id(compose, tmp_path, name, content, wandb_stub, mlflow_stub):
    (tmp_path / f"{name}.txt").write_text(content)
    with pytest.raises(CheckpointError, match=f"{name}.txt: found '.*', expected a run's id"):
        loggers(compose(f"logger={name}"), tmp_path, 1)


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_a_missing_package_is_told_with_its_extra(compose, tmp_path, name, monkeypatch):
    monkeypatch.setattr("ctm_plugin.runs.assemble.load_scene", lambda config: pytest.fail("data is read"))
    monkeypatch.setattr({"wandb": wandb, "mlflow": mlflow}[name], f"_{name.upper()}_AVAILABLE", False)
    with pytest.raises(ConfigError, match=rf"logger: found '{name}', expected .*pip install -e '.\[{name}\]'"):
        train(compose(*SMALL, f"logger={name}"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


class Service:
    """What a stand-in for a service was told: calls in order, their names and arguments."""

    def __init__(self):
        self.calls = []

    def __getattr__(self, name):
        return lambda *args, **kwargs: self.calls.append((name, args, kwargs))

    def told(self, name: str) -> list[tuple]:
        return [(args, kwargs) for each, args, kwargs in self.calls if each == name]


def module(monkeypatch, name: str, **content) -> ModuleType:
    stub = ModuleType(name)
    vars(stub).update(content)
    monkeypatch.setitem(sys.modules, name, stub)
    return stub


@pytest.fixture
def wandb_stub(monkeypatch) -> ModuleType:
    """W&B's surface as Lightning's logger uses it; runs make the link out of their folder that W&B makes."""

    class Run(Service):
        def __init__(self, settings):
            super().__init__()
            self.id, self.settings, self.config = settings["id"], settings, Service()
            logs = Path(settings["dir"], "wandb", f"offline-run-{self.id}", "logs")
            logs.mkdir(parents=True, exist_ok=True)
            with suppress(FileExistsError):
                (logs / "debug-core.log").symlink_to("/dev/null")

        def finish(self):
            stub.run = None
            stub.finished.append(self)

    def init(**settings):
        stub.run = Run(settings)
        return stub.run

    stub = module(
        monkeypatch, "wandb", init=init, run=None, finished=[], Image=lambda image: image,
        Histogram=lambda np_histogram: np_histogram,
    )  # fmt: skip
    module(monkeypatch, "wandb.sdk")
    module(monkeypatch, "wandb.sdk.lib", RunDisabled=SimpleNamespace)
    module(monkeypatch, "wandb.wandb_run", Run=SimpleNamespace)
    monkeypatch.setattr(wandb, "_WANDB_AVAILABLE", True)
    return stub


def test_wandb(compose, tmp_path, wandb_stub):
    config = compose(*SMALL, *EVERY, "logger=wandb", "logger.project=mine", "logger.group=dark")
    result = train(config, tmp_path / "run")
    assert resume(tmp_path / "run")["psnr"] == result["psnr"]
    first, again = wandb_stub.finished
    assert wandb_stub.run is None
    expected = {"project": "mine", "group": "dark", "mode": "offline", "name": "run", "resume": "allow", "id": first.id}
    assert expected.items() <= first.settings.items()
    assert again.settings == first.settings
    logged = [args[0] for args, _ in first.told("log")]
    assert [each["trainer/global_step"] for each in logged if "loss/total" in each] == [1, 2, 3, 4, 5, 6]
    pictures = [each["test/render"][0] for each in logged if "test/render" in each]
    assert [picture.size for picture in pictures] == [(12, 12)] * 4
    counts, edges = next(each["latent/scene_0"] for each in logged if "latent/scene_0" in each)
    assert (counts.sum(), len(edges)) == (1024, 65)
    assert logged[-1]["final/psnr"] == result["psnr"]
    assert first.config.told("update")[-1][0][0]["dataset"] == "ball"


@pytest.mark.parametrize(("given", "group"), [((), "sweep"), (("logger.group=mine",), "mine")])
def test_a_sweeps_runs_are_grouped(compose, tmp_path, wandb_stub, mlflow_stub, given, group):
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep" / "multirun.yaml").touch()
    run = tmp_path / "sweep" / "0"
    (service,) = loggers(compose("logger=wandb", *given), run, 0)
    assert service._wandb_init["group"] == group
    (service,) = loggers(compose("logger=mlflow"), run, 0)
    assert service.tags == {"sweep": "sweep"}
    (service,) = loggers(compose("logger=mlflow"), tmp_path / "alone", 0)
    assert not service.tags


def test_a_failed_run_is_no_part_of_the_next(compose, tmp_path, wandb_stub, die):
    die(compose(*SMALL, *EVERY, "logger=wandb"), tmp_path / "run", 2)
    assert len(wandb_stub.finished) == 1


def test_a_service_that_cannot_be_reached_is_told_before_training(compose, tmp_path, wandb_stub, monkeypatch):
    def init(**settings):
        raise OSError("not logged in")

    wandb_stub.init = init
    monkeypatch.setattr(Backbone, "training_step", lambda *_: pytest.fail("training"))
    with pytest.raises(CTMError, match="logger=wandb: not logged in"):
        train(compose(*SMALL, "logger=wandb"), tmp_path / "run")


@pytest.fixture
def mlflow_stub(monkeypatch) -> Service:
    """MLflow's surface as Lightning's logger uses it; the client of all runs."""

    class Client(Service):
        runs = ()

        def get_run(self, run_id):
            if run_id not in self.runs:
                raise LookupError(f"no run {run_id}")
            return SimpleNamespace(info=SimpleNamespace(experiment_id="0", run_id=run_id))

        def create_run(self, **settings):
            self.calls.append(("create_run", (), settings))
            self.runs = (*self.runs, f"id{len(self.runs)}")
            return self.get_run(self.runs[-1])

    def began(uri):
        client.uri = uri
        return client

    client = Client()
    module(monkeypatch, "mlflow", set_tracking_uri=lambda uri: None)
    module(monkeypatch, "mlflow.tracking", MlflowClient=began, context=SimpleNamespace(registry=None))
    module(monkeypatch, "mlflow.tracking.context")
    module(monkeypatch, "mlflow.tracking.context.registry", resolve_tags=lambda tags: tags)
    module(monkeypatch, "mlflow.utils")
    module(monkeypatch, "mlflow.utils.mlflow_tags", MLFLOW_RUN_NAME="name")
    module(monkeypatch, "mlflow.entities", Metric=SimpleNamespace, Param=SimpleNamespace)
    monkeypatch.setattr(mlflow, "_MLFLOW_AVAILABLE", True)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    return client


def test_mlflow(compose, tmp_path, mlflow_stub):
    run = tmp_path / "run"
    result = train(compose(*SMALL, *EVERY, "logger=mlflow", "logger.experiment=mine"), run)
    resume(run)
    assert mlflow_stub.uri == f"file:{run / 'mlflow'}"
    assert mlflow_stub.runs == ("id0",)  # the resumed run is the same
    assert mlflow_stub.told("get_experiment_by_name") == [(("mine",), {})]
    metrics = [each for _, said in mlflow_stub.told("log_batch") for each in said.get("metrics", ())]
    assert [each.step for each in metrics if each.key == "loss/total"] == [1, 2, 3, 4, 5, 6]
    assert {each.value for each in metrics if each.key == "final/psnr"} == {result["psnr"]}
    params = [each for _, said in mlflow_stub.told("log_batch") for each in said.get("params", ())]
    assert {each.value for each in params if each.key == "dataset"} == {"ball"}
    pictures = [(args, said) for args, said in mlflow_stub.told("log_image") if said["key"] == "test/render"]
    assert [(args[0], args[1].size, said["step"]) for args, said in pictures] == [
        ("id0", (12, 12), step) for step in (0, 2, 4, 6)
    ]


def test_a_run_that_mlflow_does_not_know(compose, tmp_path, mlflow_stub):
    train(compose(*SMALL, *EVERY, "logger=mlflow"), tmp_path / "run")
    mlflow_stub.runs = ()
    with pytest.raises(CTMError, match="logger=mlflow: no run id0"):
        resume(tmp_path / "run")
