"""What sets runs apart: names of scenes and rows, and nothing refused; which runs are found."""

import os

import pytest

from ctm_plugin.errors import CTMError
from ctm_plugin.report.labels import differing, find_runs, names
from ctm_plugin.report.labels import others as others_of


def others(*folders):
    return [tuple(others_of(run.setting).items()) for run in find_runs(folders).runs]


def scenes(*folders):
    return [run.scene for run in find_runs(folders).runs]


@pytest.mark.parametrize(
    ("argument", "key", "values"),
    [
        ("backbone.rays=7", "backbone.rays", ("1024", "7")),
        ("ctm.lr=0.1", "ctm.lr", ("0.0005", "0.1")),
        ("ctm.weights.img=1", "ctm.weights.img", ("10000", "1")),
        ("loss.weight=2", "loss.weight", ("1", "2")),
        ("trainer.precision=32-true", "trainer.precision", ("auto", "32-true")),
        ("metrics.lpips_net=vgg", "metrics.lpips_net", ("alex", "vgg")),
    ],
)
def test_any_setting_sets_rows_apart(made, argument, key, values):
    assert others(made(), made(argument)) == [((key, value),) for value in values]


def test_a_budget_is_named_without_the_sizes_that_follow_from_it(made):
    found = others(made("ctm=off"), made("ctm=off", "trainer=smoke"), made("ctm=off", "backbone.lr_grid=0.5"))
    assert [dict(each)["trainer"] for each in found] == ["quick", "smoke", "quick"]
    assert {key for each in found for key, _ in each} == {"trainer", "backbone.lr_grid"}


def test_bounds_of_one_scene_are_rows(made):
    data = ("dataset=colmap", "dataset.root=sofa", "ctm=auto")
    sofa = {"dataset": "sofa", "protocol": "sofa, 5 views"}
    kinds = ("bounded", "forward")
    folders = [made(*data, f"dataset.geometry={kind}", data=kind, **sofa) for kind in kinds]
    assert scenes(*folders) == ["sofa", "sofa"]
    assert others(*folders) == [(("dataset.geometry", kind),) for kind in kinds]


@pytest.mark.parametrize(("before", "now"), [("width=null", "width=80"), ("exposure=1", "exposure=0.1")])
def test_other_pictures_are_another_scene(made, before, now):
    data = ("dataset=colmap", "dataset.root=sofa", "ctm=auto")
    folders = [made(*data, f"dataset.{each}", dataset="sofa", protocol=each) for each in (before, now)]
    assert scenes(*folders) == [f"sofa (dataset.{each})" for each in (before, now)]
    assert others(*folders) == [(), ()]


def test_pictures_that_no_setting_tells_apart_are_told_by_protocol_or_fingerprint(made):
    assert scenes(made("ctm=off", data="aaa"), made("ctm=off", data="bbb"), made("ctm=auto", data="aaa")) == [
        "still_life (data=aaa)", "still_life (data=bbb)", "still_life (data=aaa)",
    ]  # fmt: skip
    assert scenes(made("ctm=off", protocol="7 views"), made("ctm=off", protocol="8 views")) == [
        "still_life (7 views)", "still_life (8 views)",
    ]  # fmt: skip


OFF = {"backbone": "dvgo", "ctm": "off", "color_space": "rgb", "loss": None, "appearance": "none"}
QUICK = OFF | {"ctm": "quick", "ctm.P": "4", "ctm.k": "3", "ctm.weights.dec": None}
WITHOUT = QUICK | {"ctm.weights.dec": "0"}
HEAVY = {"loss.weight": "2"}


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ([QUICK], ["backbone=dvgo ctm=quick"]),
        ([QUICK, OFF | {"ctm": "auto"}], ["ctm=quick", "ctm=auto"]),
        ([OFF, QUICK, WITHOUT], ["ctm=off", "ctm=quick", "ctm=quick ctm.weights.dec=0"]),
        ([OFF | {"ctm": "auto"}, OFF | {"ctm": "auto", "loss": "mse"}], ["backbone=dvgo ctm=auto", "loss=mse"]),
        ([QUICK, WITHOUT], ["backbone=dvgo ctm=quick", "ctm.weights.dec=0"]),
        ([QUICK | {"ctm.P": P} for P in "402"], ["ctm.P=4", "ctm.P=0", "ctm.P=2"]),
        (
            [OFF, OFF | {"color_space": "gain"}, OFF | {"backbone": "nerf"}],
            ["backbone=dvgo", "backbone=dvgo color_space=gain", "backbone=nerf"],
        ),
        (  # what most have is left out, but not where others have nothing
            [OFF | {"loss.weight": "1", "ctm": ctm} for ctm in ("off", "on", "auto")] + [OFF | {"loss.weight": "2"}],
            ["ctm=off", "ctm=on", "ctm=auto", "ctm=off loss.weight=2"],
        ),
        (
            [WITHOUT | {"loss.weight": "1"}, WITHOUT | HEAVY, QUICK | HEAVY],
            ["ctm.weights.dec=0 loss.weight=1", "ctm.weights.dec=0", "backbone=dvgo ctm=quick"],
        ),
    ],
)
def test_names_are_short_and_never_empty(settings, expected):
    assert list(names(settings).values()) == expected


@pytest.mark.parametrize(
    ("one", "other", "keys"),
    [
        (QUICK, QUICK | {"ctm.P": "2", "ctm.k": "1"}, {"ctm.P", "ctm.k"}),
        (OFF, QUICK, {"ctm"}),
        (OFF, QUICK | {"backbone": "nerf", "backbone.encoding": "x"}, {"ctm", "backbone"}),
        (QUICK, WITHOUT, {"ctm.weights.dec"}),
    ],
)
def test_differing_keys(one, other, keys):
    assert differing(one, other) == keys


def test_runs_below_a_folder_once_each(made, tmp_path):
    first, second = made("seed=0"), made("seed=1")
    (first / "evaluation").mkdir()
    (first / "evaluation" / "metrics.json").write_text((first / "metrics.json").read_text())
    found = find_runs([tmp_path, second])
    assert [run.seed for run in found.runs] == [0, 1]
    assert found.left_out == []


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
