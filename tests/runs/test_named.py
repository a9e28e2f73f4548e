"""Runs by their folder, a checkpoint, a folder of runs, or ``last``."""

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from ctm_plugin.errors import CheckpointError
from ctm_plugin.runs.rundir import CONFIG, LAST, new_folder, runs_of


def run(path: str, begun: int) -> Path:
    folder = Path(path)
    (folder / LAST).parent.mkdir(parents=True)
    (folder / LAST).touch()
    (folder / CONFIG).touch()
    os.utime(folder / CONFIG, (begun, begun))
    return folder


@pytest.fixture
def runs(tmp_path, monkeypatch) -> dict[str, Path]:
    monkeypatch.chdir(tmp_path)
    run("runs/.hidden", 9)
    times = {"runs/sofa_splat_auto": 3, "runs/sweep_1/0_a": 1, "runs/sweep_1/1_b": 2, "multirun/x": 4, "other/y": 5}
    return {name: run(name, begun) for name, begun in times.items()}


def test_a_run_and_its_checkpoint(runs):
    for name in runs:
        assert runs_of(Path(name)) == runs_of(Path(name, LAST)) == [Path(name)]


def test_a_folder_has_all_of_its_runs_the_newest_last(runs):
    assert runs_of(Path("runs/sweep_1")) == [Path("runs/sweep_1/0_a"), Path("runs/sweep_1/1_b")]
    assert runs_of(Path("runs"))[-1] == Path("runs/sofa_splat_auto")


def test_last_is_the_newest_of_the_usual_folders(runs):
    assert runs_of(Path("last")) == [Path("multirun/x")]
    os.utime(Path("runs/sweep_1/0_a", CONFIG), (7, 7))
    assert runs_of(Path("last")) == [Path("runs/sweep_1/0_a")]


def test_a_folder_called_last_goes_before_the_word(runs):
    assert runs_of(run("last", 0)) == [Path("last")]


def test_what_is_no_run_comes_back(runs):
    for name in ("nowhere", f"runs/sweep_1/0_a/{Path(LAST).parent}", f"runs/sweep_1/0_a/{CONFIG}"):
        assert runs_of(Path(name)) == [Path(name)]


def test_last_of_none(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CheckpointError, match="last: found no run in runs or multirun, expected one"):
        runs_of(Path("last"))


def test_new_folders_are_numbered(tmp_path):
    names = [new_folder(tmp_path / "große a").name for _ in range(3)]
    assert names == ["große a", "große a_2", "große a_3"]
    assert new_folder(run(str(tmp_path / "b"), 0)).name == "b_2"


def test_each_who_begins_at_once_has_a_folder_of_its_own(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(lambda _: new_folder(tmp_path / "run"), range(32)))
    assert len(set(folders)) == 32
