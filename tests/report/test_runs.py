"""Reading a run directory: its setting, and everything that is none."""

import pytest
from strangers import put

from ctm_plugin.report.labels import find_runs
from ctm_plugin.report.runs import read_run

OFF = {"backbone": "dvgo", "ctm": "off", "color_space": "rgb", "loss": None, "appearance": "none"}
TERMS = {f"ctm.weights.{term}": None for term in ("enc", "dec", "img", "rand", "latent")}
ON = OFF | {"ctm": "on", "ctm.P": "4", "ctm.k": "3"} | TERMS
BARF = {"backbone": "barf2d", "backbone.encoding": "barf"}


@pytest.mark.parametrize(
    ("arguments", "setting"),
    [
        (["ctm=off"], OFF),
        (["ctm=on"], ON),
        (["ctm=quick", "ctm.weights.dec=0"], ON | {"ctm": "quick", "ctm.weights.dec": "0"}),
        (["backbone=nerf", "ctm=off", "color_space=lab", "loss=l1"],
         OFF | {"backbone": "nerf", "color_space": "lab", "loss": "l1"}),
        (["backbone=barf2d", "ctm=auto"], OFF | BARF | {"ctm": "auto"} | TERMS),  # l1 is its own
        (["backbone=barf2d", "ctm=auto", "loss=mse"], OFF | BARF | {"ctm": "auto", "loss": "mse"} | TERMS),
        (["backbone=barf2d", "ctm=off", "loss=l1"], OFF | BARF | {"loss": "l1"}),
        (["ctm=on", "ctm.P=2", "ctm.k=5"], ON | {"ctm.P": "2", "ctm.k": "5"}),
    ],
)  # fmt: skip
def test_settings(made, arguments, setting):
    assert read_run(made(*arguments)).setting == setting


@pytest.mark.parametrize(("scores", "zeros"), [({"warp_error": 0.1}, ()), ({}, ("rand", "latent"))])
def test_settings_of_an_alignment(made, scores, zeros):
    """Its scores say that it is one, whatever the backbone's name: it needs none of the terms on random colours."""
    run = read_run(made("backbone=barf2d", "dataset=planar", "ctm=on", **scores))
    assert run.setting == ON | BARF | {f"ctm.weights.{term}": "0" for term in zeros}


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
        ("backbone.name", {}), ("color_space.name", None), ("loss.kind", 3), ("ctm.preset", []), ("ctm.weights", [1]),
        ("trainer", None), ("dataset", "x"),
    ],
)  # fmt: skip
def test_settings_of_a_wrong_kind(made, key, value):
    folder = made()
    put(folder / "config.yaml", key, value)
    assert "config.yaml: found a gap" in find_runs([folder]).left_out[0]


def test_numbers_that_are_none(made):
    values = {"lpips": None, "psnr": "30", "ssim": float("nan"), "warp_error": 10**400, "patch_psnr_pooled": True}
    run = read_run(made(**values))
    assert [run.value(metric) for metric in values] == [None] * 5
