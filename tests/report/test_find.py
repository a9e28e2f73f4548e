"""Runs below folders, and what is left out."""

import os

import pytest

from ctm_plugin.errors import CTMError
from ctm_plugin.report.find import find_runs


def test_runs_below_a_folder_once_each(made, tmp_path):
    first, second = made("seed=0"), made("seed=1")
    (first / "evaluation").mkdir()
    (first / "evaluation" / "metrics.json").write_text((first / "metrics.json").read_text())
    found = find_runs([tmp_path, second])
    assert [run.seed for run in found.runs] == [0, 1]
    assert found.left_out == []


def test_a_run_without_scores_is_unfinished(made, tmp_path):
    made()
    broken = made()
    (broken / "metrics.json").unlink()
    found = find_runs([tmp_path])
    assert len(found.runs) == 1
    assert found.left_out == [f"{broken.resolve()}: not finished"]


def test_what_a_sweep_saw_fail_is_told(made, tmp_path):
    made()
    (tmp_path / "runs" / "bad").mkdir()
    (tmp_path / "runs" / "bad" / "error.txt").write_text("error in job 3 (seed=-1): no such seed\n")
    assert find_runs([tmp_path]).left_out == [f"{tmp_path / 'runs' / 'bad'}: error in job 3 (seed=-1): no such seed"]


def test_control_characters_in_an_error_are_shown(tmp_path):
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "error.txt").write_text("one\x1b]0;two\x07\nthree\n")
    assert find_runs([tmp_path]).left_out == [f"{tmp_path / 'bad'}: one\\x1b]0;two\\x07\nthree"]


def test_a_long_error_is_cut(made, tmp_path):
    made()
    (tmp_path / "runs" / "bad").mkdir()
    (tmp_path / "runs" / "bad" / "error.txt").write_text("x" * 1_000_000)
    assert len(find_runs([tmp_path]).left_out[0]) < 20_000


def test_what_is_no_run(tmp_path):
    with pytest.raises(CTMError, match=r"nowhere: found no such directory, expected a run directory"):
        find_runs([tmp_path / "nowhere"])
    with pytest.raises(CTMError, match=r"found no config.yaml in it or below"):
        find_runs([tmp_path])


def test_of_doubles_the_newest_counts(made, tmp_path):
    first, second, other = made("ctm=off", psnr=30.0), made("ctm=off", psnr=31.0), made("ctm=off", "seed=1")
    os.utime(first / "metrics.json", (2e9, 2e9))
    found = find_runs([tmp_path])
    assert [run.folder for run in found.runs] == [first, other]
    assert found.left_out == [f"{second}: the same run as {first}, which is newer and is counted"]
