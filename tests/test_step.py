"""``benchmarks/step.py``: it runs, and its figures agree with one another."""

import json

import pytest
from pages import load

from ctm_plugin.errors import CTMError

BRIEF = ("steps=2", "warm_up=4")
DVGO = ("backbone.coarse=false", "backbone.rays=16", "backbone.voxels=32768", "backbone.grow=[]")
PLANAR = ("trainer=smoke", "dataset.height=48", "dataset.width=64", "dataset.patch=24")


@pytest.fixture
def step(monkeypatch):
    """The script, without a process for each measurement, and with little to profile."""
    module = load("benchmarks/step.py")
    monkeypatch.setattr(module, "apart", module._measure)
    monkeypatch.setattr(module, "PROFILED", 2)
    return module


@pytest.mark.parametrize(("backbone", "given"), [("dvgo", DVGO), ("barf2d", PLANAR)])
def test_figures_agree_with_one_another(step, backbone, given, ball, tmp_path, capsys):
    data = [] if backbone == "barf2d" else ["dataset=blender", f"dataset.root={ball}"]
    out = tmp_path / "found.json"
    step.main([f"backbones={backbone}", *BRIEF, f"out={out}", *data, *given])
    found = json.loads(out.read_text())[backbone]
    for side in (found["off"], found["on"]):
        assert set(side["parts_ms"]) == set(step.PARTS)
        assert sum(side["parts_ms"].values()) == pytest.approx(side["step_ms"])
        assert side["view_ms"] > 0
    sides = found["on"]["step_ms"], found["off"]["step_ms"]
    assert found["ratio"] == pytest.approx(sides[0] / sides[1], rel=1e-12)  # of the one turn that two steps are
    assert "rays per second" in capsys.readouterr().out


def test_a_machine_that_changes_its_speed_leaves_the_ratio_as_it_is(step):
    off = [10.0 * speed for speed in (1.0, 1.0, 3.0, 3.0, 1.0, 1.0, 2.0, 2.0)]
    on = [500.0, *(1.2 * each for each in off[1:])]  # one turn that something else disturbed
    assert step.ratio(on, off) == pytest.approx(1.2)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (["backbones=dvgo", "ctm=off"], "a transform to compare with"),
        (["backbones=dvgo", "ctm=on", "ctm.k=4"], "ctm.k"),
        (["steps=few"], "step.steps: found 'few', expected an integer"),
    ],
)
def test_bad_input(step, given, expected):
    with pytest.raises(CTMError, match=expected):
        step.main([*given, *DVGO])
