"""``docs/evidence/scores.py``: rows of scores.csv out of run folders."""

import csv
import io
from pathlib import Path

import pytest
from pages import load

from ctm_plugin.report.runs import read_run

ROOT = Path(__file__).parents[2]
subject = load("docs/evidence/scores.py")
COLUMNS, evidence = subject.COLUMNS, subject.evidence
VERSIONS = {"version": "0.1.0 0123456789ab+", "versions": {"torch": "2.13.0+cpu"}}


def rows(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_a_run_is_a_row(made, monkeypatch, tmp_path):
    monkeypatch.setenv("CTM_DATA", str(tmp_path))
    data = ("dataset=blender", f"dataset.root={tmp_path}/the lego", "dataset.exposure=0.02", "dataset.downscale=4")
    settings = ("ctm=off", "trainer=quick", "backbone.relative=false", "color_space=hls_cart", "seed=2")
    protocol = "lego 64x64, 25 test views 100x75, exposure 0.02"
    folder = made(*data, *settings, dataset="lego 64x64", protocol=protocol, psnr_enhanced=22.5, **VERSIONS)
    (row,) = rows(evidence([read_run(folder)]))
    assert tuple(row) == COLUMNS
    assert {key: value for key, value in row.items() if value} == {
        "scene": "lego 64x64", "light": "0.02", "backbone": "dvgo", "colours": "hls_cart", "variant": "relative=false",
        "geometry": "bounded", "background": "white", "budget": "quick", "size": "100x75", "seed": "2",
        "device": "CPU", "commit": "0123456",
        "command": "ctm dataset=blender backbone=dvgo color_space=hls_cart ctm=off trainer=quick "
                   "dataset.root=$CTM_DATA/'the lego' dataset.exposure=0.02 dataset.downscale=4 "
                   "dataset.geometry=bounded backbone.relative=false seed=2",
        "psnr": "30.0000", "psnr_brightened": "22.5000", "ssim": "0.900000", "lpips": "0.100000",
    }  # fmt: skip


def test_the_command_makes_the_same_run(made, composed, monkeypatch):
    """Its configuration is what the run had, as far as scores go."""
    folder = made("backbone=ngp", "ctm=quick", "trainer=quick", "ctm.P=2", "dataset.light=lit", "backbone.steps=7")
    (row,) = rows(evidence([read_run(folder)]))
    again, first = composed(*row["command"].split()[1:]), read_run(folder).config
    assert all(again[part] == first[part] for part in ("dataset", "backbone", "ctm", "loss", "appearance", "trainer"))
    assert (row["light"], row["variant"]) == ("lit", "steps=7 P=2")


@pytest.mark.parametrize(
    ("arguments", "scores", "light"),
    [
        ((), {"light_factor": 20.0, "enhancement_gain": None}, "dark"),  # no photograph of a test view
        ((), {"light_factor": 20.0, "enhancement_gain": 1.0}, "dark"),  # with a lamp
        ((), {"light_factor": 1.0, "enhancement_gain": 30.0}, "lit"),  # a lit scene of which the test views are dark
        ((), {"enhancement_gain": 30.0}, "dark"),  # patches
        (("dataset.exposure=0.02",), {"light_factor": 20.0}, "0.02"),
    ],
)
def test_light_is_that_of_the_training_pictures(made, arguments, scores, light):
    """An exposure of 1 says nothing: it is what every capture has."""
    run = read_run(made("dataset=colmap", "dataset.root=x", "ctm=auto", *arguments, **scores))
    assert rows(evidence([run]))[0]["light"] == light


def test_scores_without_convergence(made):
    (row,) = rows(evidence([read_run(made(converged=False, train_seconds=9.0, device="NVIDIA H100"))]))
    assert (row["psnr"], row["seconds"], row["device"]) == ("N.C.", "9.00", "NVIDIA H100")


def test_rows_are_added_and_a_run_replaces_its_own(made, tmp_path, capsys):
    out = tmp_path / "scores.csv"
    out.write_text((ROOT / "docs/evidence/scores.csv").read_text().splitlines()[0] + ",peak_memory_mb\n")
    made("seed=0", psnr=31.0, **VERSIONS)
    made("seed=1", psnr=32.0, peak_memory_mb=250.0, **VERSIONS)
    arguments = [str(tmp_path / "runs")]
    subject.main([*arguments, f"out={out}"])
    made("seed=0", psnr=33.0, **VERSIONS)
    made("seed=0", psnr=34.0, **VERSIONS | {"version": "0.1.0 ba9876543210"})
    (tmp_path / "runs/001/metrics.json").unlink()
    subject.main([*arguments, f"out={out}"])
    assert "left out: " in capsys.readouterr().err
    found = [(row["seed"], row["commit"], row["psnr"], row["peak_memory_mb"]) for row in rows(out.read_text())]
    assert found == [
        ("0", "0123456", "33.0000", ""),
        ("1", "0123456", "32.0000", "250.00"),
        ("0", "ba98765", "34.0000", ""),
    ]
    subject.main(arguments)
    assert len(rows(capsys.readouterr().out)) == 3


def test_a_file_that_is_no_table_of_scores(made, tmp_path):
    (tmp_path / "other.csv").write_text("a,b\n")
    with pytest.raises(Exception, match=r"other\.csv: found no column .*, expected a table of scores"):
        evidence([read_run(made())], tmp_path / "other.csv")
