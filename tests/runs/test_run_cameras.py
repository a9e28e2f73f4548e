"""Runs whose photographs are gone are rendered and exported from what they wrote down of their cameras."""

import json
import shutil
from dataclasses import astuple, replace
from functools import reduce
from operator import getitem
from pathlib import Path

import numpy as np
import pytest
import torch

from ctm_plugin.appearance.exposure import Exposure
from ctm_plugin.appearance.settings import ExposureConfig
from ctm_plugin.backbones.nerf import NeRF
from ctm_plugin.backbones.settings import NeRFConfig
from ctm_plugin.cli import main
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.errors import CheckpointError
from ctm_plugin.files import write_json
from ctm_plugin.runs.cameras import CAMERAS_FILE, note_cameras, noted_scene
from ctm_plugin.runs.rundir import METRICS
from ctm_plugin.scene.poses import Similarity
from ctm_plugin.scene.views import Scene

KINDS = {
    "splat": ("backbone=splat", "backbone.steps=30"),
    "dvgo": ("backbone=dvgo", "backbone.coarse=true", "appearance=exposure"),
}


def made(run: Path, out: str) -> dict[str, bytes]:
    """What render and export write, but for pictures of the data."""
    kinds = ("points", "cameras", "pictures", *(("splats",) if "splat" in run.name else ("mesh",)))
    for what in kinds:
        settings = (f"what={what}", f"out={run / out}", "points=500", "cells=8", "opaque=0.0003")
        assert main(["export", str(run), *settings]) == 0
    assert main(["render", str(run), "what=all", "frames=2", f"out={run / out / 'film.gif'}"]) == 0
    files = [path for path in (run / out).rglob("*") if path.is_file() and "images" not in path.parts]
    return {str(path.relative_to(run / out)): path.read_bytes() for path in files}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_same_files_with_and_without_photographs(ball, tmp_path, monkeypatch, capsys, kind):
    monkeypatch.setattr("ctm_plugin.export.splats.TRAIN_STEPS", 3)
    shutil.copytree(ball, tmp_path / "ball")
    run = tmp_path / kind
    data = ("dataset=blender", f"dataset.root={tmp_path / 'ball'}", "dataset.exposure=0.05")
    assert main([*data, *KINDS[kind], "trainer=smoke", "logger=none", f"hydra.run.dir={run}"]) == 0
    expected = made(run, "with")
    shutil.rmtree(tmp_path / "ball")
    with pytest.warns(UserWarning, match=f"{kind}: its photographs are gone; it goes by the cameras in {CAMERAS_FILE}"):
        assert made(run, "without") == expected
    captured, lit = (list((run / "without" / what).rglob("*.png")) for what in ("cameras", "pictures"))
    assert (len(captured), len(lit)) == (0, 10)
    for command in (["evaluate"], ["resume"], ["export", "what=pictures", "photographs=true"]):
        assert main([command[0], str(run), *command[1:]]) == 1
        assert "expected them there, or dataset.root=FOLDER" in capsys.readouterr().err.replace("\n", "")


@pytest.fixture
def scene(ball) -> Scene:
    """With all that a scene may have: moved, through lenses, masked, of floats without alpha, with EXIF's lights."""
    scene = BlenderConfig(root=ball).load()
    train = scene.train
    mask = torch.rand(train.images.shape[:3]) > 0.3
    mask[:, :, 9:] = False
    more = {"distortion": torch.rand(len(train), 5), "mask": mask, "exposures": torch.rand(len(train)) + 0.1}
    more["sizes"] = torch.arange(2 * len(train)).view(-1, 2) % 8 + 1
    train = replace(train, images=train.images[..., :3] / 2550, **more)
    return replace(scene, train=train, world=Similarity(0.3, np.eye(3)[[1, 2, 0]], np.array([0.1, 2, -3]), 0.0, 0.0))


def test_all_but_the_pictures_comes_back(scene, tmp_path):
    module = NeRF(NeRFConfig(), scene)
    note_cameras(tmp_path, module)
    found = noted_scene(tmp_path)
    for key in ("name", "near", "far", "geometry", "background", "dark"):
        assert getattr(found, key) == getattr(scene, key)
    assert found.light == astuple(module.light)
    assert module.light.gain > 1
    for split in ("train", "test"):
        before, after = getattr(scene, split), getattr(found, split)
        assert after.names == before.names
        assert (after.images.shape, after.images.dtype) == (before.images.shape, before.images.dtype)
        for key in ("c2w", "intrinsics", "distortion", "mask", "exposures", "sizes", "extents"):
            one, other = getattr(before, key), getattr(after, key)
            assert other is None if one is None else torch.equal(one, other)
        assert not after.pictured.any()
    for one, other in zip(scene.world, found.world, strict=True):
        np.testing.assert_array_equal(one, other)


def test_light_that_hangs_on_weights_is_that_of_the_scores(scene, tmp_path):
    module = NeRF(NeRFConfig(), scene)
    module.appearance = Exposure(ExposureConfig(), scene.train)
    note_cameras(tmp_path, module)
    assert noted_scene(tmp_path) is None
    write_json(tmp_path / METRICS, {"light_factor": 3.5, "light_contrast": 1.2, "light_saturation": 1.1})
    assert noted_scene(tmp_path).light == (3.5, 1.2, 1.1)


def test_older_runs_have_none(tmp_path):
    assert noted_scene(tmp_path) is None


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("train.names.0", "../../outside"),
        ("train.names.0", "a\\b"),
        ("train.names", []),
        ("train.c2w.0.0.0", "x"),
        ("train.c2w.0", []),
        ("train.c2w.0.0.0", 1e300),
        ("test.size", [100_000, 100_000, 3]),
        ("test.size.2", 5),
        ("train.mask", [1, 2]),
        ("train.mask", [-1]),
        ("train.sizes.0", [0, 1]),
        ("train.sizes.0", [1, 100]),
        ("near", None),
        ("far", 0),
        ("light", [-1, 1, 1]),
        ("light", [2, 1]),
        ("light", "x"),
        ("geometry", "os.system"),
        ("background", []),
        ("world.scale", 0),
        ("world.turn", [[1]]),
        ("world.more", 1),
        ("test", []),
    ],
)
def test_what_cannot_be_used_is_refused(scene, tmp_path, key, value):
    note_cameras(tmp_path, NeRF(NeRFConfig(), scene))
    note = json.loads((tmp_path / CAMERAS_FILE).read_text())
    *parents, last = [int(part) if part.isdigit() else part for part in key.split(".")]
    reduce(getitem, parents, note)[last] = value
    (tmp_path / CAMERAS_FILE).write_text(json.dumps(note))
    with pytest.raises(
        CheckpointError, match=rf"{CAMERAS_FILE}: found no cameras \(.*\), expected what a run writes there"
    ):
        noted_scene(tmp_path)
