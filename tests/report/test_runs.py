"""Reading run directories: settings, what may not be mixed, and everything that is none."""

import json

import pytest
from mutations import put

from ctm_plugin.errors import CTMError
from ctm_plugin.report.runs import Setting, check_alike, find_runs, read_run


@pytest.mark.parametrize(
    ("arguments", "setting"),
    [
        (["ctm=off"], Setting("dvgo", "off")),
        (["ctm=on"], Setting("dvgo", "on", P=4, k=3)),
        (["ctm=quick", "ctm.weights.dec=0"], Setting("dvgo", "quick", without=frozenset(["dec"]), P=4, k=3)),
        (["backbone=nerf", "ctm=off", "color_space=lab", "loss=l1"], Setting("nerf", "off", "lab", "l1")),
        (["backbone=barf2d", "ctm=auto"], Setting("barf2d", "auto", encoding="barf")),  # l1 is its own
        (["backbone=barf2d", "ctm=auto", "loss=mse"], Setting("barf2d", "auto", loss="mse, said", encoding="barf")),
        (["backbone=barf2d", "ctm=off", "loss=l1"], Setting("barf2d", "off", loss="l1", encoding="barf")),
        (["ctm=on", "ctm.P=2", "ctm.k=5"], Setting("dvgo", "on", P=2, k=5)),
    ],
)
def test_settings(made, arguments, setting):
    assert read_run(made(*arguments)).setting == setting


def test_settings_of_an_alignment(made):
    """Its scores say that it is one, whatever the backbone's name: it needs none of the terms on random colours."""
    aligned, views = (
        made("backbone=barf2d", "dataset=planar", "ctm=on", **scores) for scores in ({"warp_error": 0.1}, {})
    )
    setting = Setting("barf2d", "on", P=4, k=3, encoding="barf")
    assert read_run(aligned).setting == setting
    assert read_run(views).setting == setting._replace(without=frozenset(["rand", "latent"]))


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


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("metrics.json", "{", "metrics.json: found no readable JSON"),
        ("metrics.json", "[]", "metrics.json: found a list, expected a mapping"),
        ("metrics.json", '{"psnr": 3}', "metrics.json: found nothing for protocol, dataset, steps"),
        ("metrics.json", "[" * 100_000, "metrics.json: found no readable JSON"),
        ("metrics.json", b"\xff\xfe\x00", "metrics.json: found no readable JSON"),
        ("config.yaml", "a: [", "config.yaml: found no readable YAML"),
        ("config.yaml", "seed: 0", "config.yaml: found a gap"),
        ("metrics.json", '{"protocol": "", "dataset": "", "steps": 1, "per_image": [{}]}', "found a gap"),
        ("metrics.json", '{"protocol": [], "dataset": "", "steps": 1}', "metrics.json: found a gap"),
        ("metrics.json", '{"protocol": "", "dataset": {}, "steps": 1}', "metrics.json: found a gap"),
        ("metrics.json", '{"protocol": "", "dataset": "", "steps": null}', "metrics.json: found a gap"),
        ("metrics.json", '{"protocol": "", "dataset": "", "steps": 1, "per_image": 3}', "metrics.json: found a gap"),
        ("config.yaml", "!!python/object/apply:os.system ['true']", "config.yaml: found no readable YAML"),
    ],
)
def test_broken_files_are_named(made, name, text, message):
    folder = made()
    (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    (told,) = find_runs([folder, made()]).left_out
    assert message in told
    assert str(folder) in told


@pytest.mark.parametrize("name", ["../../secret", "/secret", "..", "a/b", "", 3, None, ["a"]])
def test_views_are_files_of_the_run(made, tmp_path, name):
    """Their pictures go into the HTML report: a stranger's run must not choose them elsewhere."""
    folder = made(per_image=[{"name": name}])
    assert "metrics.json: found a gap (a view's name is" in find_runs([folder]).left_out[0]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("seed", 1.5), ("seed", "x"), ("seed", -1), ("seed", []), ("seed", float("inf")), ("backbone.name", ["dvgo"]),
        ("backbone.name", {}), ("backbone.encoding", {}), ("color_space.name", None), ("loss.kind", 3),
        ("ctm.preset", []), ("ctm.P", "4"), ("ctm.k", [3]), ("ctm.weights", [1]), ("trainer", None), ("dataset", "x"),
    ],
)  # fmt: skip
def test_settings_of_a_wrong_kind(made, key, value):
    folder = made()
    put(folder / "config.yaml", key, value)
    assert "config.yaml: found a gap" in find_runs([folder]).left_out[0]


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


def test_numbers_that_are_none(made):
    folder = made(lpips=None, psnr="30", ssim=float("nan"), warp_error=10**400, patch_psnr_pooled=True)
    run = read_run(folder)
    assert run.value("warp_error") is None
    assert run.value("patch_psnr_pooled") is None
    assert run.value("lpips") is None
    assert run.value("psnr") is None
    assert run.value("ssim") is None
    assert json.loads((folder / "metrics.json").read_text())["psnr"] == "30"


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
    runs = find_runs([made("ctm=off"), made("ctm=off", "trainer=smoke", protocol="another")]).runs
    assert [run.setting.others for run in runs] == [(), ()]
    with pytest.raises(CTMError, match="do not share a table"):
        check_alike(runs)


def test_of_doubles_the_first_is_taken(made, tmp_path):
    first, second, other = made("ctm=off", psnr=30.0), made("ctm=off", psnr=31.0), made("ctm=off", "seed=1")
    found = find_runs([tmp_path])
    assert [run.folder for run in found.runs] == [first, other]
    assert found.left_out == [f"{second}: the same run as {first}, which is taken"]
