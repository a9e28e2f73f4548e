"""Sweeps: the rows of the paper's tables, failures, and going on."""

import csv
import importlib
import io
import itertools
import json
import shutil
import signal
import time
import weakref
from pathlib import Path

import pytest
import yaml
from forked import Command
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from omegaconf import OmegaConf

from ctm_plugin.cli import main
from ctm_plugin.compose.command_line import conf_dir
from ctm_plugin.cpu import allocator
from ctm_plugin.errors import CTMError
from ctm_plugin.runs import train as training
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.rundir import CONFIG, METRICS, load_config, save_config


@pytest.fixture
def recorded(monkeypatch, tmp_path) -> list[dict]:
    """Runs write their configuration and a PSNR instead of training; the configurations in order.

    Nothing is done for each job twice: it is composed once, and no garbage is collected after it.
    """
    found = []
    Plugins.instance()  # which imports the sweeper
    sweeper = importlib.import_module("hydra_plugins.ctm_rows.sweeper").RowsSweeper
    monkeypatch.setattr(sweeper, "validate_batch_is_legal", lambda self, jobs: None)
    monkeypatch.setattr(allocator, "give_back", lambda: None)

    def train(config, folder: Path, *_) -> dict:
        if config["loss"]["weight"] == 7:
            raise CTMError("on purpose")
        found.append(config)
        save_config(folder, config)
        (folder / METRICS).write_text(json.dumps({"psnr": 20.0 + len(found)}))
        return {"psnr": 20.0 + len(found)}

    monkeypatch.setattr("ctm_plugin.runs.sweep.train", train)  # first: it may only now import the other
    monkeypatch.setattr(training, "train", train)
    monkeypatch.chdir(tmp_path)
    return found


FULL = {"enc": 1.5, "dec": 1.5, "img": 10000, "rand": 100, "latent": 1000}


SPACES = ("rgb", "hls", "hls_cart", "hsv", "hsv_cart", "lab", "luv")
ABLATED = [{**FULL, term: 0} for term in ("dec", "img", "rand", "latent")]
ROWS = {
    "table1": [("off", "dvgo"), ("off", "nerf"), ("quick", "dvgo"), ("quick", "nerf")],
    "table2": [*((space, "off") for space in SPACES), ("rgb", "on")],
    "table3": [*itertools.product(("off", "on"), ("none", "naive", "barf"))],
    "table4": [("off", None), *(("quick", weights) for weights in (*ABLATED, FULL))],
    "table5": [(p, 3) for p in (0, 2, 4, 6, 8, 10)] + [(4, k) for k in (1, 2, 4, 5)],  # the full one once
    "table6": [("mse", "off"), ("l1", "off"), ("mse", "quick"), ("l1", "quick")],
    "table7": [("off", 9), ("quick", 9)],
    "colors": [*(("off", space) for space in ("rgb", "gain", "log")), ("quick", "rgb"), ("auto", "rgb")],
}
KEYS = {
    "table1": ("ctm.preset", "backbone.name"), "table2": ("color_space.name", "ctm.preset"),
    "table3": ("ctm.preset", "backbone.encoding"), "table4": ("ctm.preset", "ctm.weights"),
    "table5": ("ctm.P", "ctm.k"), "table6": ("loss.kind", "ctm.preset"), "table7": ("ctm.preset", "seed"),
    "colors": ("ctm.preset", "color_space.name"),
}  # fmt: skip
SEEDS = {"table3": "range(10)", "table7": "0,1,2,3"}


@pytest.mark.slow
@pytest.mark.parametrize("table", ROWS)
def test_rows_of_a_table(recorded, table):
    chosen = ["ctm=on"] if table == "table2" else ["seed=9"] if table in SEEDS or table == "table4" else []
    assert main(["-m", f"+experiment={table}", *chosen]) == 0
    keys = [key.split(".") for key in KEYS[table]]
    rows = [tuple(c[key] if not more else c[key].get(*more) for key, *more in keys) for c in recorded]
    assert rows == ROWS[table]
    assert {c["seed"] for c in recorded} == {9 if "seed=9" in chosen else 0}
    sweep = yaml.safe_load((conf_dir() / f"experiment/{table}.yaml").read_text())["hydra"]
    assert table == "colors" or sweep["sweep"]["dir"] == f"runs/{table}"
    if table in SEEDS:  # where none are given: its rows with each of them would take long to compose
        assert sweep["sweeper"]["params"]["seed"] == SEEDS[table]


def test_colors_on_every_dark_scene():
    """The rows are those of ``colors``; ``test_command_lines.py`` composes them on every scene."""
    plain, dark = (
        yaml.safe_load((conf_dir() / f"experiment/{name}.yaml").read_text())["hydra"]["sweeper"]
        for name in ("colors", "colors_dark")
    )
    rows = [{key: value for key, value in row.items() if key != "dataset.background_level"} for row in dark["rows"]]
    assert rows == plain["rows"]
    scenes = [Path(scene.get("dataset.root", scene["dataset"])).name for scene in dark["scenes"]]
    assert scenes == [
        "bike", "chair", "buu", "fern", "still_life,white_room", "workshop_dark", "stairwell_dark",
        "lego_400", "lego_400", "BlueHawaii", "Cupcake",
    ]  # fmt: skip


@pytest.mark.slow
def test_every_row_on_every_scene(recorded):
    rows, scenes = "[{loss: l1},{seed: 5}]", "[{seed: 1,ctm: 'off'},{seed: 2}]"
    assert main(["-m", f"hydra.sweeper.rows={rows}", f"hydra.sweeper.scenes={scenes}", "ctm=on", "loss=mse"]) == 0
    assert [(c["ctm"]["preset"], c["seed"], c["loss"]["kind"]) for c in recorded] == [
        ("off", 1, "l1"), ("off", 5, "mse"), ("on", 2, "l1"), ("on", 5, "mse"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("rows", "given", "expected"), [("{seed: 5}", "seed=1,2", [5, 1, 2]), ("{seed: '5,6'}", "++seed=1", [5, 6, 1])]
)
def test_a_rows_keys_go_before_the_command_lines_and_those_before_the_shared(recorded, rows, given, expected):
    """A plus before a key changes nothing of that."""
    assert main(["-m", f"hydra.sweeper.rows=[{rows},{{}}]", "+hydra.sweeper.params={seed: 3,loss: l1}", given]) == 0
    assert [(c["seed"], c["loss"]["kind"]) for c in recorded] == [(seed, "l1") for seed in expected]


@pytest.mark.parametrize(("key", "sets"), [("rows", "[]"), ("scenes", "null")])
def test_a_sweep_of_nothing_is_refused(recorded, capsys, key, sets):
    assert main(["-m", f"hydra.sweeper.{key}={sets}"]) == 1
    assert f"hydra.sweeper.{key}: found {sets}".replace("null", "None") in capsys.readouterr().err
    assert recorded == []


def test_null_and_another_order(recorded):
    rows = "hydra.sweeper.rows=[{ctm.random_colors: null,ctm.k: 2},{ctm.k: 2,ctm.random_colors: null}]"
    assert main(["-m", rows, "ctm=quick"]) == 0
    assert [(c["ctm"]["random_colors"], c["ctm"]["k"]) for c in recorded] == [(None, 2)]


def test_a_sweep_with_plus(recorded):
    """Its flag stands at the end here, in front elsewhere."""
    assert main(["+backbone=dvgo", "+ctm=on,off", "seed=0,1", "hydra.sweep.dir=all", "-m"]) == 0
    jobs = [("on", 0), ("on", 1), ("off", 0), ("off", 1)]
    assert [(config["ctm"]["preset"], config["seed"]) for config in recorded] == jobs
    names = [f"{job}_still_life_dvgo_ctm-{ctm}_seed{seed}" for job, (ctm, seed) in enumerate(jobs)]
    assert sorted(path.parent.name for path in Path("all").rglob(METRICS)) == names


@pytest.mark.slow
def test_names_that_hydra_would_not_read(recorded, ball, capsys, refused):
    """A run, a sweep over two folders, and the command that goes on with the sweep."""
    names = ["cap (1)", "20240501"]
    for name in names:
        shutil.copytree(ball, name)
    assert main(["dataset=blender", f"dataset.root={names[0]}", "hydra.run.dir=Lauf, 1"]) == 0
    assert main([f"dataset.root={names[1]}"]) == 0
    assert Path("Lauf, 1", METRICS).is_file()
    assert Path("runs/20240501_dvgo_auto", METRICS).is_file()
    sweep = ["-m", "dataset.root=cap (1),20240501", "hydra.sweep.dir=alle (2)"]
    assert main(sweep) == 0
    assert [config["dataset"]["root"] for config in recorded] == 2 * names
    assert len(list(Path("alle (2)").rglob(METRICS))) == 2
    capsys.readouterr()
    assert "found the runs of an earlier sweep" in refused(*sweep, "seed=3")


def test_a_failure_does_not_end_the_sweep(recorded, capsys):
    assert main(["-m", "loss.weight=1,7,2", "hydra.sweep.dir=s"]) == 1
    assert [c["loss"]["weight"] for c in recorded] == [1, 2]
    told = capsys.readouterr()
    assert "error in job 1 (loss.weight=7): on purpose" in told.err
    assert "1 of 3 runs failed" in told.err
    assert "sweep.resume=true" in told.err
    assert "Traceback" not in told.err
    lines = told.out.splitlines()[:-1]  # the last is the next command
    heading, *rows = lines[lines.index("3 runs in s") + 1 :]
    assert heading.split() == ["run", "PSNR"]
    assert [row.split() for row in rows] == [
        ["0", "loss.weight=1", "21.00", "dB"], ["1", "loss.weight=7", "failed"], ["2", "loss.weight=2", "22.00", "dB"],
    ]  # fmt: skip


@pytest.mark.slow
def test_going_on_runs_what_is_missing(recorded, capsys):
    assert main(["-m", "seed=0,1", "hydra.sweep.dir=s"]) == 0
    before = {path: path.stat().st_mtime_ns for path in Path("s").rglob(METRICS)}
    assert main(["-m", "seed=2,1,0", "hydra.sweep.dir=s", "sweep.resume=true"]) == 0
    assert [c["seed"] for c in recorded] == [0, 1, 2]
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert capsys.readouterr().out.count("finished before") == 2
    assert {load_config(path.parent)["seed"] for path in Path("s").rglob(METRICS)} == {0, 1, 2}


def test_the_table_knows_runs_by_their_configuration(recorded, capsys):
    """Their numbers differ from the earlier sweep's."""
    assert main(["-m", "loss.weight=1", "hydra.sweep.dir=s"]) == 0
    assert main(["-m", "loss.weight=2,1", "hydra.sweep.dir=s", "sweep.resume=true"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[-3:-1]]
    assert rows == [["0", "loss.weight=2", "22.00", "dB"], ["1", "loss.weight=1", "21.00", "dB"]]
    assert [c["loss"]["weight"] for c in recorded] == [1, 2]
    first, second = sorted(path.parent.name for path in Path("s").rglob(METRICS))
    assert second == f"{first}_2"  # another run of the same name stays


@pytest.mark.slow
def test_what_auto_came_to_is_no_other_run(recorded):
    assert main(["-m", "seed=0", "hydra.sweep.dir=s"]) == 0
    (run,) = (path.parent for path in Path("s").rglob(METRICS))
    config = load_config(run)
    assert config["trainer"]["precision"] == "auto"
    (run / CONFIG).unlink()
    save_config(run, config | {"trainer": config["trainer"] | {"precision": "bf16-mixed"}})
    assert main(["-m", "seed=0", "hydra.sweep.dir=s", "sweep.resume=true"]) == 0
    assert main(["-m", "seed=0", "trainer.precision=32-true", "hydra.sweep.dir=s", "sweep.resume=true"]) == 0
    assert [c["trainer"]["precision"] for c in recorded] == ["auto", "32-true"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-m", "seed=0", "hydra.sweep.dir=s"], "s: found the runs of an earlier sweep, expected sweep.resume=true"),
        (["-m", "sweep.resume=maybe"], "sweep.resume: found 'maybe', expected true or false"),
        (["sweep.resume=true"], "resume=RUN_DIR"),
        (["-m", "loss.weight=interval(0,1)"], "loss.weight: found 'loss.weight=interval(0,1)', expected choices"),
        (["-m", "experiment=table9"], "table7"),
    ],
)
def test_bad_input(recorded, refused, arguments, message):
    assert main(["-m", "seed=0", "hydra.sweep.dir=s"]) == 0
    assert message in refused(*arguments)
    assert len(recorded) == 1


def sweep(ball: Path, folder: Path, *more: str) -> list[str]:
    sizes = ("trainer=smoke", "backbone.coarse=false", "backbone.steps_alone=6", "backbone.grow=[]", "ctm=off")
    choices = ("backbone.rays=0,16", "seed=range(4)")
    return ["-m", "dataset=blender", f"dataset.root={ball}", *sizes, *choices, f"hydra.sweep.dir={folder}", *more]


@pytest.mark.slow
def test_eight_runs_some_impossible_and_killed_halfway(ball, tmp_path, capsys):
    """The first four of the eight ask for 0 rays; the process is killed while the others run."""
    folder = tmp_path / "sweep"
    process = Command(*sweep(ball, folder), told=tmp_path / "told")
    deadline = time.monotonic() + 300
    while len(list(folder.glob(f"*/{METRICS}"))) < 1:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    main(["report", str(folder), "format=csv"])
    assert "backbone.rays: found 0" in capsys.readouterr().err
    before = {path: path.stat().st_mtime_ns for path in folder.glob(f"*/{METRICS}")}
    assert 1 <= len(before) < 4

    assert main(sweep(ball, folder, "sweep.resume=true")) == 1
    error = capsys.readouterr().err
    assert error.count("backbone.rays: found 0") == 4
    assert "4 of 8 runs failed" in error
    assert {path: path.stat().st_mtime_ns for path in before} == before
    seeds = [json.loads(path.read_text())["seed"] for path in folder.glob(f"*/{METRICS}")]
    assert sorted(seeds) == list(range(4))
    assert len(list(folder.glob(f"*/{CONFIG}"))) == 4
    assert main(["report", str(folder), "format=csv"]) == 0
    told = capsys.readouterr()
    assert told.err.count("left out: ") == told.err.count("backbone.rays: found 0") == 4
    (row,) = (row for row in csv.DictReader(io.StringIO(told.out)) if row["metric"] == "psnr")
    assert row["runs"] == "4"


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments", [["seed=0,1"], ["seed=0,1", "backbone.lr_grid=1e30"]], ids=["finished", "diverged"]
)
def test_runs_in_one_process_leave_nothing_in_memory(ball, tmp_path, monkeypatch, arguments):
    alive = []

    def assembled(*given, **named):
        parts = assemble(*given, **named)
        alive.append(weakref.ref(parts.backbone))
        return parts

    monkeypatch.setattr(training, "assemble", assembled)
    monkeypatch.chdir(tmp_path)
    sizes = ("trainer=smoke", "backbone.coarse=false", "backbone.steps_alone=3", "backbone.grow=[]", "ctm=off")
    main(["-m", "dataset=blender", f"dataset.root={ball}", *sizes, *arguments, "hydra.sweep.dir=s"])
    assert len(alive) == 2
    assert [each() for each in alive] == [None, None]


def test_a_bug_in_a_run_keeps_its_traceback(recorded, monkeypatch, capsys):
    def train(config, folder, *_):
        raise RuntimeError("a bug")

    monkeypatch.setattr(training, "train", train)
    assert main(["-m", "seed=0,1", "hydra.sweep.dir=s"]) == 1
    told = capsys.readouterr().err
    assert told.count("RuntimeError: a bug") == 2
    assert "in train" in next(Path("s").glob("0_*/error.txt")).read_text()


def test_every_row_of_the_table_at_the_end_has_a_name(tmp_path):
    """One that leaves a group as it is, which others set, has the choice of its configuration."""
    outcomes = importlib.import_module("hydra_plugins.ctm_rows.sweeper").outcomes
    composed = OmegaConf.create({"hydra": {"runtime": {"choices": {"ctm": "quick", "backbone": "dvgo"}}}})
    failed = JobReturn(hydra_cfg=composed, status=JobStatus.FAILED)
    jobs = [["seed=0", "ctm=off"], ["seed=0", "ctm.weights.dec=0"], ["seed=0"]]
    named = [what for what, _ in outcomes(jobs, [failed] * 3, tmp_path)]
    assert named == ["ctm=off", "ctm.weights.dec=0 ctm=quick", "ctm=quick"]
