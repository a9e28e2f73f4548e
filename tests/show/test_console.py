"""What a run and a sweep print at their end."""

import io
from pathlib import Path

import pytest
from rich.console import Console

from ctm_plugin.show import console
from ctm_plugin.show.console import print_file, print_line, print_summary, print_sweep

METRICS = {
    "dataset": "ball", "backbone": "dvgo", "ctm": "on", "seed": 3, "psnr": 31.234, "ssim": 0.91, "lpips": None,
    "train_seconds": 61.4, "rays_per_second": 12345.6, "converged": True,
}  # fmt: skip


@pytest.fixture
def folder(tmp_path) -> Path:
    """A run's directory with a name longer than a line."""
    run = tmp_path / ("a_long_name" * 12)
    (run / "lit").mkdir(parents=True)
    (run / "metrics.json").touch()
    return run


def test_a_run_as_plain_text(folder, capsys):
    print_summary(METRICS, folder)
    out = capsys.readouterr().out
    assert out.isprintable() or set(out) - set("\n") == {c for c in out if c.isprintable()}
    assert not set(out) & set("\x1b│┃━─")
    title, *rows, last, following = out.splitlines()
    assert title == "ball · dvgo · ctm=on · seed 3"
    assert [row.split("  ")[0].strip() for row in rows] == [
        "PSNR", "SSIM", "training", "rays per second", "lit views", "scores",
    ]  # fmt: skip
    assert rows[0].split() == ["PSNR", "31.23", "dB"]
    assert rows[-2].split() == ["lit", "views", "lit"]
    assert last == f"written to {folder}"
    assert following == f"next: ctm view {folder}"


def test_a_test_of_the_command_says_so(folder, capsys):
    for measured, told in ((False, 1), (True, 0)):
        print_summary(METRICS | {"measured": measured, "steps": 20}, folder)
        assert capsys.readouterr().out.count("20 steps: a test of the command, not a measurement") == told


def test_what_is_fitted_to_photographs_is_told_where_they_differ(folder, capsys):
    for appearance in ("none", "exposure"):
        print_summary(METRICS | {"psnr_fitted": 30.0, "appearance": appearance}, folder)
        assert ("light fitted" in capsys.readouterr().out) == (appearance != "none")


def test_a_run_of_a_sweep_is_one_line(folder, capsys):
    print_line(METRICS | {"converged": False}, folder, "finished before: ")
    told = "PSNR 31.23 dB  SSIM 0.9100  training 61 s  not converged"
    assert capsys.readouterr().out == f"finished before: {told}  written to {folder}\n"


def test_a_sweep(folder, capsys):
    print_sweep([("seed=0", METRICS), ("seed=1", None), ("seed=2", {"psnr": None, "ssim": 0.5})], folder)
    title, heading, *rows, following = capsys.readouterr().out.splitlines()
    assert following == f"next: ctm report {folder}"
    assert title.strip() == f"3 runs in {folder}"
    assert heading.split() == ["run", "PSNR", "SSIM", "training"]
    assert [row.split() for row in rows] == [
        ["0", "seed=0", "31.23", "dB", "0.9100", "61", "s"], ["1", "seed=1", "failed"],
        ["2", "seed=2", "-", "0.5000", "-"],
    ]  # fmt: skip


def test_names_are_no_markup(tmp_path, capsys):
    folder = tmp_path / "[red]" / "[" / "x]"
    folder.mkdir(parents=True)
    print_summary(METRICS | {"dataset": "[bold]"}, folder)
    print_sweep([("dataset.root=/data/[old]/[/x]", METRICS)], folder)
    out = capsys.readouterr().out
    assert "[bold] · " in out
    assert out.count(str(folder)) == 4
    assert "dataset.root=/data/[old]/[/x]" in out


def test_a_sweep_whose_runs_all_failed(tmp_path, capsys):
    print_sweep([("seed=0", None)], tmp_path)
    assert capsys.readouterr().out.splitlines()[-1].split() == ["0", "seed=0", "failed"]


def test_lines_on_a_terminal(folder, monkeypatch):
    out = io.StringIO()
    monkeypatch.setattr(console, "output_console", lambda: Console(file=out, force_terminal=True, width=80))
    print_summary(METRICS, folder)
    assert "│" in out.getvalue()


def test_a_file_is_a_link_on_a_terminal_alone(tmp_path, capsys, monkeypatch):
    path = tmp_path / "a b.html"
    print_file("all of it: ", path)
    assert capsys.readouterr().out == f"all of it: {path}\n"
    out = io.StringIO()
    monkeypatch.setattr(console, "Console", lambda: Console(file=out, force_terminal=True, color_system="standard"))
    print_file("all of it: ", path)
    start, address, *_ = out.getvalue().split("\x1b]8;")[1].split("\x1b\\")
    assert address == str(path)
    assert start.endswith(f";{path.as_uri()}")
    assert path.as_uri().endswith("/a%20b.html")
