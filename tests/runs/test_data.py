"""A run finds its data where they lie now, and tells where they are others."""

import json
import shutil
import warnings
from pathlib import Path

import pytest

from ctm_plugin.cli import main
from ctm_plugin.errors import CheckpointError, ConfigError
from ctm_plugin.runs.data import DATA_FILE, located
from ctm_plugin.runs.load import load_posed
from ctm_plugin.runs.rundir import LAST, METRICS


@pytest.fixture(scope="module")
def pair(ball, tmp_path_factory) -> Path:
    """A folder with ``ball`` and a run of it, which knows it by a path from there."""
    home = tmp_path_factory.mktemp("pair")
    shutil.copytree(ball, home / "ball")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(home)
        small = ("trainer=smoke", "backbone.coarse=false", "backbone.steps_alone=3", "backbone.grow=[]", "logger=none")
        assert main(["dataset=blender", "dataset.root=ball", *small, "hydra.run.dir=run"]) == 0
    return home


@pytest.fixture
def here(pair, tmp_path, monkeypatch) -> Path:
    """A copy of it, without the first one's path to fall back on, seen from elsewhere."""
    home = Path(shutil.copytree(pair, tmp_path / "here"))
    note = json.loads((home / "run" / DATA_FILE).read_text())
    assert note["root"] == str(pair / "ball")
    (home / "run" / DATA_FILE).write_text(json.dumps(note | {"root": str(home / "ball")}))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    return home


def psnr(run: Path) -> float:
    return json.loads((run / "evaluation" / METRICS).read_text())["psnr"]


@pytest.fixture(scope="module")
def expected(pair) -> float:
    return json.loads((pair / "run" / METRICS).read_text())["psnr"]


@pytest.mark.parametrize("moved", [False, True])
def test_from_another_working_directory(here, expected, moved):
    there = here.rename(here.with_name("there")) if moved else here  # run and data together
    assert main(["evaluate", str(there / "run")]) == 0
    assert psnr(there / "run") == expected


def test_without_a_note(here):
    (here / "run" / DATA_FILE).unlink()
    config = {"dataset": {"name": "blender", "root": "ball"}}
    assert located(config, here / "run")["dataset"]["root"] == str(here / "ball")
    with pytest.raises(CheckpointError, match="found none of its data at gone, expected them there, or"):
        located({"dataset": {"root": "gone"}}, here)


@pytest.mark.parametrize("command", ["evaluate {}", "resume={}"])
def test_data_moved_away(here, expected, capsys, command):
    arguments = command.format(here / "run").split()
    (here / "ball").rename(here / "große Aufnahme")
    assert main(arguments) == 1
    told = capsys.readouterr().err.replace("\n", "")
    assert f"found none of its data at {here / 'ball'}, expected them there, or dataset.root=FOLDER" in told
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the same data, under another name
        assert main([*arguments, f"dataset.root={here / 'große Aufnahme'}"]) == 0
        assert main(["evaluate", str(here / "run")]) == 0  # it is told once
    assert psnr(here / "run") == expected


@pytest.mark.slow
def test_other_data_are_told_and_not_gone_on_with(here, refused):
    path = here / "ball" / "transforms_test.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"camera_angle_x": 0.3}))
    run = str(here / "run")
    told = r"run: other data than it was trained on: test\.intrinsics changed"
    with pytest.warns(UserWarning, match=told):
        assert main(["evaluate", run]) == 0
    with pytest.warns(UserWarning, match=told):
        load_posed(Path(run, LAST).parents[1], str(here / "ball"))  # saying where they are makes them no others
    with pytest.warns(UserWarning, match=told):
        assert main(["evaluate", run]) == 0
    assert "other data than it was trained on: test.intrinsics changed, expected the same;" in refused("resume", run)
    with pytest.warns(UserWarning, match=told):
        assert main(["resume", run, f"dataset.root={here / 'ball'}"]) == 0


def test_data_without_a_folder():
    config = {"dataset": {"name": "still_life"}}
    assert located(config, Path("run")) is config
    with pytest.raises(ConfigError, match=r"dataset\.root: found 'x', expected nothing"):
        located(config, Path("run"), "x")
