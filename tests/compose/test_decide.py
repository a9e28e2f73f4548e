"""What is left to the program: decided by what the capture is, said, and never against what was given."""

import shutil
from collections import Counter
from pathlib import Path

import pytest
import torch
from PIL import Image

from ctm_plugin.cli import main
from ctm_plugin.compose import decide
from ctm_plugin.compose.command_line import compose
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.data.llff import LLFFConfig
from ctm_plugin.data.readers import records as reading
from ctm_plugin.data.rig import Rig


@pytest.mark.parametrize(
    ("scene", "layout", "more", "expected"),
    [
        ("hall", "llff", (), "forward"),
        ("ball", "blender", (), "bounded"),
        ("hall", "llff", ("dataset.geometry=bounded",), "bounded"),
    ],
)
def test_the_geometry_is_that_of_the_cameras(request, capsys, scene, layout, more, expected):
    root = request.getfixturevalue(scene)
    config = compose(f"dataset={layout}", f"dataset.root={root}", "backbone=dvgo", "trainer=quick", *more)
    assert config["dataset"]["geometry"] == config["backbone"]["geometry"] == expected
    assert config["backbone"]["voxels"] == {"bounded": 64**3, "forward": 64**3 * 4}[expected]  # budgets hang on it
    assert (f"dataset.geometry={expected}: " in capsys.readouterr().err) == (not more)


def test_without_a_word_it_is_the_recommendation(capsys):
    config = compose()
    assert (config["ctm"]["preset"], config["trainer"]["budget"], config["backbone"]["name"]) == (
        "auto",
        "standard" if torch.cuda.is_available() else "quick",
        "dvgo",
    )
    assert config["dataset"]["geometry"] == "bounded"
    assert compose("trainer=paper")["trainer"]["budget"] == "paper"
    assert compose("+backbone=dvgo", "+ctm=on")["ctm"]["preset"] == "on"


@pytest.mark.parametrize(("size", "gpu", "expected"), [
    ((100, 133), False, "quick"), ((375, 500), False, "standard"), ((100, 133), True, "standard"),
])  # fmt: skip
def test_the_budget_goes_by_pixels_and_device(monkeypatch, size, gpu, expected):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    rig = Rig(torch.eye(4)[None, :3].numpy().astype("float64"), 0.5, size, False)
    assert decide.budget(rig, "auto")[0] == expected
    assert decide.budget(rig, "cpu")[0] == ("quick" if size[0] < 300 else "standard")


@pytest.mark.parametrize(("backbone", "given", "gpu", "installed", "expected"), [
    ("splat", "auto", True, (), "cpu"),
    ("splat", "auto", True, ("triton",), "auto"),
    ("splat", "gpu", True, (), "gpu"),
    ("splat", "auto", False, (), "auto"),
    ("dvgo", "auto", True, (), "auto"),
])  # fmt: skip
def test_splats_stay_on_the_processor_where_a_gpu_has_nothing_to_composite_them_with(
    capsys, monkeypatch, backbone, given, gpu, installed, expected
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    monkeypatch.setattr(decide, "find_spec", lambda name: name in installed or None)
    config = compose(f"backbone={backbone}", f"trainer.accelerator={given}")
    assert config["trainer"]["accelerator"] == expected
    assert ("trainer.accelerator=cpu: splats on a GPU need" in capsys.readouterr().err) == (expected == "cpu")
    assert config["trainer"]["budget"] == ("standard" if gpu and expected != "cpu" else "quick")


@pytest.mark.parametrize(("scene", "records"), [("ball", 2), ("hall", 0)])
def test_what_it_read_is_not_read_again(request, small, untrained, monkeypatch, scene, records):
    """From a folder to the first step: a file with cameras, and a picture's header and its pixels, once each."""
    root, times = Path(shutil.copytree(request.getfixturevalue(scene), "fresh")), Counter()

    def counted(module, name):
        own = getattr(module, name)

        def function(*args, **named):
            times[name] += 1
            return own(*args, **named)

        monkeypatch.setattr(module, name, function)

    for module, name in ((BlenderConfig, "capture"), (LLFFConfig, "capture"), (Image, "open")):
        counted(module, name)
    counted(reading, "parse_record")
    with pytest.raises(AssertionError, match="training has begun"):
        main([f"dataset.root={root}", "backbone=dvgo", "ctm=off", *small[2:]])
    pictures = [path for path in root.rglob("*.png") if not path.stem.endswith("_depth")]
    depths = list(root.glob("test/*_depth.png"))
    assert times == {"capture": 1, "open": 2 * len(pictures) + len(depths)} | ({"parse_record": 2} if records else {})
