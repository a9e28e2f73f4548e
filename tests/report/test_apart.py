"""What sets runs apart: names of scenes and rows, and nothing refused."""

import pytest

from ctm_plugin.report.apart import differing, names
from ctm_plugin.report.find import find_runs
from ctm_plugin.report.runs import Setting


def others(*folders):
    return [run.setting.others for run in find_runs(folders).runs]


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


def test_seeds_and_logs_set_nothing_apart(made):
    folders = [made("ctm=off"), made("ctm=off", "seed=3"), made("ctm=off", "seed=4", "trainer.log_every=3")]
    assert others(*folders) == [(), (), ()]


def test_what_else_differs_sets_runs_apart(made, tmp_path):
    """Keys of a plug-in's transform, of a backbone, the loss's weight: of those that share them."""
    for arguments in (["ctm=off"], ["ctm=off", "loss.weight=43"], ["ctm=on", "ctm.lr=0.1"], ["ctm=on"]):
        made(*arguments)
    heavy, light = ("loss.weight", "43"), ("loss.weight", "1")
    assert others(tmp_path) == [(light,), (heavy,), (("ctm.lr", "0.1"), light), (("ctm.lr", "0.0005"), light)]


def test_names_are_short_and_never_empty():
    off, full = Setting("dvgo", "off"), Setting("dvgo", "quick", P=4, k=3)
    without = full._replace(without=frozenset(["dec"]))
    wide = [full._replace(P=P) for P in (0, 2)]
    assert names([full]) == {full: "backbone=dvgo ctm=quick"}
    assert list(names([full, Setting("dvgo", "auto")]).values()) == ["ctm=quick", "ctm=auto"]
    assert list(names([off, full, without]).values()) == ["ctm=off", "ctm=quick", "ctm=quick ctm.weights.dec=0"]
    assert list(names([full, without]).values()) == ["backbone=dvgo ctm=quick", "ctm.weights.dec=0"]
    assert list(names([full, *wide]).values()) == ["ctm.P=4", "ctm.P=0", "ctm.P=2"]
    spaces = [off, off._replace(color_space="gain"), off._replace(backbone="nerf")]
    assert list(names(spaces).values()) == ["backbone=dvgo", "backbone=dvgo color_space=gain", "backbone=nerf"]


def test_names_leave_out_what_most_have():
    settings = [Setting("dvgo", "off", others=(("loss.weight", weight),)) for weight in "12"]
    settings += [Setting("dvgo", ctm, others=(("loss.weight", "1"),)) for ctm in ("on", "auto")]
    assert list(names(settings).values()) == ["ctm=off", "ctm=off loss.weight=2", "ctm=on", "ctm=auto"]


def test_differing_keys():
    off, quick = Setting("dvgo", "off"), Setting("dvgo", "quick", P=4, k=3)
    assert differing(quick, quick._replace(P=2, k=1)) == {"ctm.P", "ctm.k"}
    assert differing(off, quick) == {"ctm"}
    assert differing(off, quick._replace(backbone="nerf", encoding="x")) == {"ctm", "backbone"}
    assert differing(quick, quick._replace(without=frozenset(["rand"]))) == {"ctm.weights.rand"}
