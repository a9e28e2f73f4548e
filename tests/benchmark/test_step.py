"""A backbone under the clock."""

import json

import pytest
import torch
from forked import server

from ctm_plugin import cli
from ctm_plugin.benchmark.step import PARTS, _measure, measure, ratio

DVGO = (
    "backbone.coarse=false",
    "backbone.rays=16",
    "backbone.voxels=32768",
    "backbone.grow=[]",
    "trainer.precision=32-true",
)
PLANAR = ("trainer=smoke", "dataset.height=48", "dataset.width=64", "dataset.patch=24")
RAYS = {"dvgo": 16, "nerf": 64, "ngp": 64, "splat": 144, "barf2d": 320}
NERF = ("trainer=smoke", "backbone.coarse_samples=5", "backbone.fine_samples=7")
SIZES = {"dvgo": DVGO, "nerf": NERF, "ngp": ("trainer=smoke",), "splat": ("trainer=smoke",), "barf2d": PLANAR}
POINTS = {"nerf": 5 + 12, "splat": 1, "barf2d": 1}
"""Points a ray; of NeRF those of both networks."""


@pytest.fixture(autouse=True)
def briefly(monkeypatch) -> None:
    """What the profiler writes down of a step takes longer to read than the step, and the machine's limits to find."""
    monkeypatch.setattr("ctm_plugin.benchmark.step.PROFILED", 2)
    monkeypatch.setattr("ctm_plugin.benchmark.step.describe", lambda device: {"device": str(device)})


@pytest.mark.parametrize("backbone", SIZES)
def test_figures_agree_with_one_another(backbone, ball):
    data = [] if backbone == "barf2d" else ["dataset=blender", f"dataset.root={ball}"]
    found = measure(backbone, [*data, *SIZES[backbone]], 2, 4)
    for name in ("off", "on"):
        side = found[name]
        assert set(side["parts_ms"]) == set(PARTS)
        assert all(part >= 0 for part in side["parts_ms"].values())
        assert sum(side["parts_ms"].values()) == pytest.approx(side["step_ms"])
        assert side["rays_per_second"] * side["step_ms"] / 1e3 == pytest.approx(RAYS[backbone])
        assert side["flops_per_second"] * side["step_ms"] / 1e3 == pytest.approx(side["flops"])
        assert side["view_ms"] > 0
    assert found["on"]["points_per_ray"] == found["off"]["points_per_ray"]
    assert found["on"]["flops"] > found["off"]["flops"]
    sides = found["on"]["step_ms"], found["off"]["step_ms"]
    assert found["ratio"] == pytest.approx(sides[0] / sides[1], rel=1e-12)  # of the one turn that two steps are
    if backbone in POINTS:
        assert found["off"]["points_per_ray"] == POINTS[backbone]
    json.dumps(found)


def test_a_machine_that_changes_its_speed_leaves_the_ratio_alone():
    speeds = [1.0, 1.0, 3.0, 3.0, 1.0, 1.0, 2.0, 2.0]
    off = [10.0 * speed for speed in speeds]
    on = [12.0 * speed for speed in speeds]
    on[0] = 500.0  # one turn that something else disturbed
    assert ratio(on, off) == pytest.approx(1.2)
    first = [1.0, 3.0] * 4  # whoever comes first in a turn is slower, by turns
    assert ratio([2 * each for each in first], first[1:] + first[:1]) == pytest.approx(2)


def test_without_ctm_alone(ball):
    found = measure("dvgo", ["dataset=blender", f"dataset.root={ball}", *DVGO], 2, 4, alone=True)
    assert "on" not in found
    assert "ratio" not in found
    assert found["off"]["step_ms"] > 0


@pytest.fixture
def forked(monkeypatch) -> None:
    """The process that measures begins with everything imported."""
    monkeypatch.setattr("ctm_plugin.benchmark.step.get_context", lambda kind: server())


def test_a_file_and_a_table(forked, ball, tmp_path, capsys):
    out = tmp_path / "found.json"
    given = ["dataset=blender", f"dataset.root={ball}", *DVGO]
    assert cli.main(["benchmark", "backbones=dvgo", "steps=1", "warm_up=2", f"out={out}", *given]) == 0
    assert json.loads(out.read_text())["dvgo"]["machine"]["threads"] == torch.get_num_threads()
    shown = capsys.readouterr().out
    assert "rays per second" in shown
    assert "dvgo" in shown


def test_bad_input_is_told_by_the_process_that_measures(forked, tmp_path, capsys):
    assert cli.main(["benchmark", f"out={tmp_path / 'found.json'}", "backbones=dvgoo"]) == 1
    assert "backbone" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["backbones=dvgoo"], "dvgo"),
        (["backbones=dvgo", "ctm=off"], "a transform to compare with"),
        (["backbones=dvgo", "+ctm=on", "ctm.k=4"], "ctm.k"),
        (["backbones=dvgo", "backbone.nope=1"], "backbone.nope"),
        (["backbones=dvgo", "dataset=blender", "dataset.root=/nowhere"], "/nowhere"),
    ],
)
def test_bad_input(arguments, expected, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("ctm_plugin.benchmark.command.apart", _measure)
    out = tmp_path / "found.json"
    assert cli.main(["benchmark", f"out={out}", *arguments]) == 1
    assert expected in capsys.readouterr().err
    assert not out.exists()
