"""Reading a run directory: its setting, and everything that is none."""

import json

import pytest
from mutations import put

from ctm_plugin.report.find import find_runs
from ctm_plugin.report.runs import Setting, read_run


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
        ("metrics.json", '{"protocol": "", "dataset": "", "steps": 1, "lpips_net": []}', "metrics.json: found a gap"),
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
        ("dataset.background_level", [1]), ("backbone.geometry", ["forward"]),
    ],
)  # fmt: skip
def test_settings_of_a_wrong_kind(made, key, value):
    folder = made()
    put(folder / "config.yaml", key, value)
    assert "config.yaml: found a gap" in find_runs([folder]).left_out[0]


def test_numbers_that_are_none(made):
    folder = made(lpips=None, psnr="30", ssim=float("nan"), warp_error=10**400, patch_psnr_pooled=True)
    run = read_run(folder)
    assert run.value("warp_error") is None
    assert run.value("patch_psnr_pooled") is None
    assert run.value("lpips") is None
    assert run.value("psnr") is None
    assert run.value("ssim") is None
    assert json.loads((folder / "metrics.json").read_text())["psnr"] == "30"
