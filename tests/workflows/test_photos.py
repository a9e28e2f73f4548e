"""One command from photographs to lit views, on a hall that is dark."""

import os
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from ctm_plugin.cli import main
from ctm_plugin.errors import DataError
from ctm_plugin.workflows.photos import choices

SMALL = ("trainer=smoke", "backbone=dvgo", "backbone.steps_alone=3", "backbone.grow=[]", "dataset.exposure=0.05")


@pytest.fixture
def capture(hall, tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(hall, tmp_path / "große Halle")
    return Path("große Halle")


def test_from_a_folder_to_lit_views_and_a_film(capture, capsys):
    assert main(["photos", str(capture), *SMALL]) == 0
    said = capsys.readouterr()
    run = Path("runs") / "große Halle"
    assert "dataset.geometry=forward: all 17 cameras look one way" in said.err
    assert "17 photographs" in said.out
    names = {path.name for path in (run / "lit").iterdir()}
    assert names == {path.name for path in (run / "photo").iterdir()} == {"00.png", "08.png", "16.png"}
    (film,) = (run / "video").iterdir()
    assert (run / "index.html").stat().st_size < 10_000_000
    assert len(list((run / "all").iterdir())) == 17
    scored, other = (np.asarray(Image.open(run / folder / "08.png"), int) for folder in ("lit", "all"))
    assert abs(scored - other).mean() < 1
    assert said.out.splitlines()[-5:] == [
        f"lit views: {run / 'all'}",
        f"film:      {film}",
        f"scores:    {run / 'metrics.json'}",
        f"all of it: {run / 'index.html'}",
        f"next: ctm view '{run}'",
    ]
    before = [path.stat().st_mtime_ns for path in (film, run / "index.html")]
    assert main(["photos", str(capture), *SMALL]) == 0  # finished: nothing is done again
    assert [path.stat().st_mtime_ns for path in (film, run / "index.html")] == before
    assert main(["photos", str(capture), "again=true", *SMALL]) == 0
    assert (Path("runs") / "große Halle_2" / "lit").is_dir()


@pytest.mark.slow
def test_stopped_the_same_command_goes_on(capture, capsys, ctrl_c):
    ctrl_c(lambda step: step == 2)
    assert main(["photos", str(capture), *SMALL]) == 130
    told = f"stopped after step 3; go on with: ctm photos '{capture}' {' '.join(SMALL[:3])} 'backbone.grow=[]' "
    assert capsys.readouterr().err.splitlines()[-1].startswith(told)
    ctrl_c(lambda step: False)
    assert main(["photos", str(capture), *SMALL]) == 0
    assert "going on with runs/große Halle, with its own settings\n" in capsys.readouterr().out
    assert [path.name for path in Path("runs").iterdir()] == ["große Halle"]


@pytest.mark.slow
def test_stopped_before_the_film_the_same_command_makes_it(capture, capsys, monkeypatch):
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("ctm_plugin.export.video.film", stopped)
        assert main(["photos", str(capture), "again=true", *SMALL]) == 130
    assert f"stopped; go on with: ctm photos '{capture}' again=true " in capsys.readouterr().err
    assert main(["photos", str(capture), "again=true", *SMALL]) == 0
    assert [path.name for path in Path("runs").iterdir()] == ["große Halle"]


def test_a_dry_run_says_what_it_would_do_and_writes_nothing(capture, capsys, ctrl_c):
    def tree() -> list[Path]:
        return sorted(Path().rglob("*"))

    before = tree()
    assert main(["photos", str(capture), *SMALL, "--cfg", "job"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("17 photographs, ")
    assert said[-1] == "then runs/große Halle would get lit views (all/), a film (video/) and index.html"
    assert tree() == before
    ctrl_c(lambda step: step == 2)
    assert main(shlex.split(said[-2])[1:]) == 130  # the command that it names is the one that photos runs
    begun = tree()
    assert main(["photos", str(capture), *SMALL, "--cfg", "job"]) == 0
    assert capsys.readouterr().out.startswith("it would go on with runs/große Halle, with its own settings\n")
    assert tree() == begun


def test_a_dry_run_without_cameras(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "notes.txt").touch()
    assert main(["photos", "capture", "--cfg", "job"]) == 1
    assert "capture: found no photographs and no clips" in capsys.readouterr().err
    for name in ("a.jpg", "b.HEIC", "c.mov"):
        (tmp_path / "capture" / name).write_bytes(b"x")
    walked, walk = [], os.walk
    monkeypatch.setattr(os, "walk", lambda folder, **more: walked.append(folder) or walk(folder, **more))
    assert main(["photos", "capture", "-c", "job", "minutes=3"]) == 0
    assert walked == [Path("capture")]  # once
    assert capsys.readouterr().out.splitlines() == [
        "cameras: none found; COLMAP would search for them in 2 photographs and 1 clips",
        "then width and budget would be chosen for minutes=3",
        "then runs/capture would get lit views (all/), a film (video/) and index.html",
    ]
    assert len(list((tmp_path / "capture").iterdir())) == 4
    assert not Path("runs").exists()
    assert main(["photos", "capture", "--cfg", "all"]) == 2
    assert "found --cfg all, expected --cfg job" in capsys.readouterr().err


def test_a_photograph_that_cannot_be_read_is_refused_before_anything_slow(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "ctm_plugin.cameras.command", None)  # with what it takes seconds to import
    (tmp_path / "my capture").mkdir()
    for level, (name, size) in enumerate((("a", (6, 8)), ("b", (8, 6)), ("c", (8, 6)))):
        Image.new("RGB", size, (50 * level, 0, 0)).save(tmp_path / "my capture" / f"{name}.JPG")
    (tmp_path / "my capture" / "d.JPG").write_bytes(b"x")
    assert main(["photos", "my capture"]) == 1
    assert capsys.readouterr().err.startswith("error: my capture/d.JPG: found something that is not an image, expected")


def test_photographs_that_were_added_are_searched_anew(capture, monkeypatch, capsys):
    """Into the place of the cameras that ``ctm cameras`` found; a run that has begun keeps its own."""
    asked = []

    def place(root, settings):
        asked.append(settings.overwrite)
        raise DataError(root, "no place", "some")

    monkeypatch.setattr("ctm_plugin.cameras.command.find_and_write", place)
    monkeypatch.setattr("ctm_plugin.workflows.photos.added", lambda root, name: ["new.png"])
    assert main(["photos", str(capture), *SMALL]) == 1
    assert asked == [True]
    assert "cameras: 1 photographs were added since the search; COLMAP searches" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("spread", "more", "expected"),
    [(0.3, (), True), (0.04, (), False), (0.3, ("appearance=none",), False), (0.3, ("+appearance=none",), False)],
)
def test_uneven_photographs_are_evened_unless_told_otherwise(capture, monkeypatch, spread, more, expected):
    gains = torch.tensor([spread, -spread, torch.nan])
    monkeypatch.setattr("ctm_plugin.workflows.photos.model_folder", lambda root: root)
    monkeypatch.setattr("ctm_plugin.appearance.measured_gains.gains_by_points", lambda scene: gains)
    said = []
    chosen = choices(capture, 1.0, [*SMALL, *more], said.append)
    assert ("appearance=exposure" in chosen) == expected
    line = "appearance=exposure, started at the points' light: the photographs' exposures spread by 30%"
    assert (line in said) == expected


def test_runs_that_cannot_be_written_are_refused_before_cameras_are_searched(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "ctm_plugin.cameras.command", None)
    (tmp_path / "capture").mkdir()
    (tmp_path / "runs").write_text("in the way")
    for level, name in enumerate("abc"):
        Image.new("RGB", (8, 6), (50 * level, 0, 0)).save(tmp_path / "capture" / f"{name}.png")
    assert main(["photos", "capture"]) == 1
    assert f"error: {tmp_path / 'runs'}: found no directory to write to (Not a directory)" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture", "runs"]


def test_what_is_given_stays(capture, capsys):
    assert main(["photos", str(capture), *SMALL, "dataset.width=12", "ctm=off"]) == 0
    assert "17 photographs, 12 pixels wide, budget smoke\n" in capsys.readouterr().out
    config = (Path("runs") / capture.name / "config.yaml").read_text(encoding="utf-8")
    assert "width: 12\n" in config
    assert "name: none" in config.split("ctm:")[1][:40]


@pytest.mark.parametrize(
    ("argument", "told"),
    [
        ("minuts=3", "minuts: found an unknown key, expected one of again, minutes; did you mean minutes?"),
        ("hydra.run.dir=x", "hydra.run.dir: found 'x', expected none: it writes into runs/ where it is started"),
    ],
)
def test_keys_that_it_has_not(capture, capsys, argument, told):
    assert main(["photos", str(capture), *SMALL, argument]) == 1
    assert capsys.readouterr().err == f"error: {told}\n"
