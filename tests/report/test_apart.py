"""What may not be mixed in one table, and what sets rows apart."""

import pytest

from ctm_plugin.errors import CTMError
from ctm_plugin.report.alike import check_alike
from ctm_plugin.report.find import find_runs
from ctm_plugin.report.runs import read_run


@pytest.mark.parametrize(
    ("arguments", "metrics", "message"),
    [
        (["dataset.exposure=0.1"], {}, "dataset.exposure=0.1, expected 1.0"),
        (["backbone.rays=7"], {}, "backbone.rays=7, expected 1024"),
        (["ctm.lr=0.1"], {}, "ctm.lr=0.1, expected 0.0005"),
        (["ctm.weights.img=1"], {}, "ctm.weights.img=1, expected 10000"),
        (["loss.weight=2"], {}, "loss.weight=2, expected 1"),
        (["trainer.precision=32-true"], {}, "trainer.precision=32-true, expected auto"),
        ([], {"protocol": "other"}, "protocol 'other', expected 'still_life, 2 test views'"),
        ([], {"data": "bbb"}, "data 'bbb', expected 'aaa'"),
        ([], {"lpips_net": "vgg"}, "lpips_net 'vgg', expected 'alex'"),
        (["ctm=off", "backbone.steps_alone=20000"], {}, "backbone.steps_alone=20000, expected 1000"),
    ],
)
def test_mixed_protocols(made, arguments, metrics, message):
    if arguments and arguments[0].startswith("dataset"):
        arguments = ["dataset=blender", "dataset.root=x", *arguments]
        first = made("dataset=blender", "dataset.root=x")
    else:
        first = made(data="aaa", lpips_net="alex")
    second = made(*arguments, **metrics)
    with pytest.raises(CTMError, match="do not share a table") as error:
        check_alike([read_run(first), read_run(second)])
    assert message in str(error.value)
    assert str(first) in str(error.value)
    assert str(second) in str(error.value)


def test_what_tables_vary_may_differ(made, tmp_path):
    for arguments in (["ctm=off"], ["ctm=on"], ["seed=3"], ["color_space=lab"], ["loss=l1"], ["backbone=nerf"],
                      ["ctm.weights.dec=0"], ["ctm.P=2"], ["trainer.log_every=3"]):  # fmt: skip
        made(*arguments)
    made("dataset=white_room", dataset="room", protocol="white_room, 7 test views")
    check_alike(find_runs([tmp_path]).runs)


def test_what_else_differs_sets_runs_apart(made, tmp_path):
    """Keys of a plug-in's transform, of a backbone, the loss's weight: of those that share them."""
    for arguments in (["ctm=off"], ["ctm=off", "loss.weight=43"], ["ctm=on", "ctm.lr=0.1"], ["ctm=on"],
                      ["backbone=nerf", "ctm=off"]):  # fmt: skip
        made(*arguments)
    weight = {"off": ("loss.weight", "1"), "heavy": ("loss.weight", "43")}
    found = [(run.setting.backbone, run.setting.others) for run in find_runs([tmp_path]).runs]
    assert found == [
        ("dvgo", (weight["off"],)),
        ("dvgo", (weight["heavy"],)),
        ("dvgo", (("ctm.lr", "0.1"), weight["off"])),
        ("dvgo", (("ctm.lr", "0.0005"), weight["off"])),
        ("nerf", ()),
    ]


def test_two_budgets_are_no_rows(made):
    """A row's name would have to tell them apart by all their sizes."""
    runs = find_runs([made("ctm=off"), made("ctm=off", "trainer=smoke")]).runs
    assert [run.setting.others for run in runs] == [(), ()]
    with pytest.raises(CTMError, match="do not share a table"):
        check_alike(runs)
