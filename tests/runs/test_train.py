"""A whole run: what is in its directory, what stops it, and that every shipped choice trains."""

import json
import math
import shutil
import warnings
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
import yaml
from faults import TIMES, scores

from ctm_plugin import __version__, cli
from ctm_plugin.backbones.base import Backbone
from ctm_plugin.backbones.dvgo import DVGO
from ctm_plugin.backbones.voxels import VoxelField
from ctm_plugin.color.light import Light
from ctm_plugin.compose.command_line import conf_dir
from ctm_plugin.cpu import adam
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.errors import CheckpointError, ConfigError
from ctm_plugin.metrics.image import psnr
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.cameras import CAMERAS_FILE
from ctm_plugin.runs.data import DATA_FILE
from ctm_plugin.runs.evaluate import evaluate
from ctm_plugin.runs.provenance import code_version, versions
from ctm_plugin.runs.rundir import CONFIG, LAST, METRICS
from ctm_plugin.runs.settings import TrainerConfig
from ctm_plugin.runs.train import resume, train, warn_of_short_run
from ctm_plugin.scene.views import composite
from ctm_plugin.settings.listing import choices

SMALL = ("backbone.coarse=false", "backbone.steps_alone=6", "backbone.grow=[3]", "backbone.occupancy_first=2")


@pytest.fixture(scope="module")
def config(compose) -> dict[str, Any]:
    return compose(*SMALL, "dataset.exposure=0.1", "dataset.background=black")


@pytest.fixture(scope="module")
def run(config, tmp_path_factory) -> Path:
    """Of DVGO on a dark ball, not to be changed."""
    run = tmp_path_factory.mktemp("run") / "new" / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ctm_plugin.runs.evaluate.load_lpips", lambda path, net: (None, "not here"))
        train(config, run)
    return run


def metrics(run: Path) -> dict[str, Any]:
    return json.loads((run / METRICS).read_text())


# The run directory


def test_files(run):
    names = {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file() and "tensorboard" not in str(path)}
    kinds = ("lit", "photo", "dark", "depth", "latent")
    pictures = {f"{kind}/r_{view}.png" for view in range(2) for kind in kinds}
    assert names == {CONFIG, DATA_FILE, CAMERAS_FILE, METRICS, LAST} | pictures
    assert list((run / "tensorboard").glob("events.out.tfevents.*"))


def test_config_holds_all_that_was_resolved(run, config):
    assert yaml.safe_load((run / CONFIG).read_text()) == {"version": __version__, **config}
    assert "${" not in (run / CONFIG).read_text()


def test_every_figure(run):
    found = metrics(run)
    expected = {
        "steps": 6, "backbone": "dvgo", "ctm": "on", "color_space": "rgb", "dataset": "ball", "seed": 0,
        "precision": "32-true", "version": code_version(), "versions": versions(),
        "lpips": None, "lpips_net": None, "lpips_reason": "not here",
        "enhancement_gain": pytest.approx(10.0), "converged": False,
    }  # fmt: skip
    assert {key: found[key] for key in expected} == expected
    for key in ("psnr", "ssim", "psnr_enhanced", "constant_psnr", "depth_mae", *TIMES):
        assert isinstance(found[key], float), key
        assert math.isfinite(found[key]), key
    assert found["protocol"] == (
        "ball, 2 test views 12x12, exposure 0.1, black background, float RGB clipped to [0, 1], "
        "PSNR and SSIM per image then mean"
    )
    assert found["rays_per_second"] == pytest.approx(6 * 64 / found["train_seconds"])
    assert [view["name"] for view in found["per_image"]] == ["r_0", "r_1"]
    for key in ("psnr", "ssim", "psnr_enhanced"):
        assert found[key] == pytest.approx(np.mean([view[key] for view in found["per_image"]]))
    assert all(view["depth_mae"] is not None for view in found["per_image"])
    assert not found.keys() & {"terms", "nan"}
    assert len(found["data"]) == 32


def test_pictures_show_what_was_scored(run, ball):
    views = BlenderConfig(root=ball, exposure=0.1).load().test
    for index, view in enumerate(metrics(run)["per_image"]):
        photograph = iio.imread(run / "photo" / f"r_{index}.png") / 255
        light = Light(*(metrics(run)[f"light_{name}"] for name in ("factor", "contrast", "saturation")))
        expected = light.apply(composite(views.images[index], torch.zeros(1, 3)))
        assert np.abs(photograph - expected.numpy()).max() <= 0.5 / 255 + 1e-6
        picture = torch.from_numpy(iio.imread(run / "dark" / f"r_{index}.png")).double() / 255
        target = composite(views.images[index], torch.zeros(1, 3)).double()
        assert float(psnr(picture[None], target[None])) == pytest.approx(view["psnr"], abs=0.1)  # rounded to 8 bits
        lit = iio.imread(run / "lit" / f"r_{index}.png")
        assert lit.mean() > 1.5 * iio.imread(run / "dark" / f"r_{index}.png").mean()
        for kind in ("depth", "latent"):
            assert iio.imread(run / kind / f"r_{index}.png").shape == (12, 12, 3)


# Seeds and precision


def test_a_seed_decides_all(config, run, tmp_path):
    train(config, tmp_path / "again")
    assert scores(tmp_path / "again") | {"lpips_reason": ""} == scores(run) | {"lpips_reason": ""}
    train(config | {"seed": 1}, tmp_path / "other")
    assert scores(tmp_path / "other")["psnr"] != scores(run)["psnr"]


@pytest.mark.slow
def test_training_learns(compose, tmp_path):
    long = ("backbone.steps_alone=60", "ctm.pretrain_steps=300", "ctm.lr=0.005", "dataset.background=random_matched")
    result = train(compose(*SMALL, *long, "backbone.rays=256"), tmp_path)
    assert result["converged"]
    assert result["psnr"] > result["constant_psnr"] + 3


def test_automatic_precision_is_settled_once(compose, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    train(compose(*SMALL, "trainer.precision=auto"), tmp_path)
    monkeypatch.setattr(torch.cpu, "get_capabilities", dict)  # another machine
    assert evaluate(tmp_path) == resume(tmp_path) == metrics(tmp_path)
    assert metrics(tmp_path)["precision"] == "bf16-mixed"
    saved = torch.load(tmp_path / LAST, weights_only=True)["state_dict"]
    assert {value.dtype for name, value in saved.items() if name.startswith("transform.")} == {torch.float32}


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize("precision", ["bf16-mixed", "32-true", "auto"])
def test_automatic_precision_is_the_fast_one(monkeypatch, fast, precision):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": fast})
    settings = TrainerConfig(budget="quick", accelerator="cpu", precision=precision)
    assert settings.numbers == ({True: "bf16-mixed", False: "32-true"}[fast] if precision == "auto" else precision)


@pytest.mark.parametrize(
    ("accelerator", "cuda", "expected"),
    [("auto", True, "cuda"), ("auto", False, "cpu"), ("cpu", True, "cpu"), ("gpu", False, "cuda")],
)
def test_what_trains(monkeypatch, accelerator, cuda, expected):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
    assert TrainerConfig(budget="quick", accelerator=accelerator).backend == expected


# What stops a run


def test_a_nan_stops_the_run_which_can_go_on(arguments, compose, tmp_path, monkeypatch, capsys):
    """The smoothness of the field becomes NaN in one batch."""
    own, run = DVGO.regularisers, tmp_path / "run"

    def regularisers(self, *args):
        return own(self, *args) | {"smooth": torch.tensor(math.nan if self.batches_seen == 6 else 0.0)}

    with monkeypatch.context() as patch:
        patch.setattr(DVGO, "regularisers", regularisers)
        assert cli.main([*arguments, *SMALL, "trainer.checkpoint_every=2", f"hydra.run.dir={run}"]) == 1
    told = f"training stopped, last good checkpoint kept: {run / LAST}"
    error = capsys.readouterr().err
    assert error.endswith(f"error: step 5: loss term 'smooth' is nan; {told}\n")
    assert "Traceback" not in error
    assert not (run / METRICS).exists()
    assert evaluate(run)["steps"] == 4
    resume(run)
    train(compose(*SMALL, "trainer.checkpoint_every=2"), tmp_path / "whole")
    assert scores(run) == scores(tmp_path / "whole")


def test_an_unwritable_run_directory(config, tmp_path, monkeypatch):
    monkeypatch.setattr(Backbone, "training_step", None)
    (tmp_path / "file").write_text("")
    with pytest.raises(CheckpointError, match=r"file/run: found no directory to write to \(Not a directory\)"):
        train(config, tmp_path / "file" / "run")


def test_a_configuration_is_checked_before_data_are_read(config, tmp_path, monkeypatch):
    monkeypatch.setattr("ctm_plugin.runs.assemble.load_scene", None)
    for group, wrong in (("trainer", {"devices": 0}), ("metrics", {"lpips_net": "x"}), ("ctm", {"k": 0})):
        with pytest.raises(ConfigError, match=f"{group}."):
            train(config | {group: config[group] | wrong}, tmp_path)
    for wrong in ({"seed": -1}, {"resume": "somewhere"}, {"other": 1}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            train(config | wrong, tmp_path)
    assert not list(tmp_path.glob("[!t]*"))


# Every shipped choice

# Keys that make a choice small; data sets need more than their name.
PATCHES = ("dataset=planar", "dataset.height=40", "dataset.width=50", "dataset.patch=16")
CHOICES = {
    "dataset": dict.fromkeys(("still_life", "white_room"), (*SMALL, "dataset.downscale=8", "dataset.skip=20")),
    "backbone": {"barf2d": PATCHES},
    # The ball is not in front of its cameras.
    "experiment": {"table3": PATCHES}
    | {f"low_texture_blender_{each}": ("dataset.geometry=bounded",) for each in ("dvgo", "nerf")},
    "ctm": {"quick": (*SMALL, "ctm.pretrain_steps=2"), "release": (*SMALL, "ctm.pretrain_steps=2")},
}
OTHERWISE = dict.fromkeys(("ctm", "color_space", "loss"), SMALL)
SHIPPED = [
    (group, choice)
    for group in ("dataset", "backbone", "ctm", "color_space", "loss", "experiment")
    for choice in choices(conf_dir(), group)
    # Of data sets those that come with the package: the others need a folder.
    if group != "dataset" or choice in CHOICES["dataset"]
    if choice != "lom"  # which needs pictures in normal light beside dark ones
]


@pytest.mark.parametrize(
    ("group", "choice"),
    [
        pytest.param(*each, marks=[pytest.mark.slow] * (each[0] in ("color_space", "loss", "experiment")))
        for each in SHIPPED
    ],
)
def test_every_shipped_choice_trains(compose, tmp_path, group, choice):
    sizes = CHOICES.get(group, {}).get(choice, OTHERWISE.get(group, ()))
    result = train(compose(f"+{group}={choice}", *sizes), tmp_path)
    assert result["steps"] > 0
    assert math.isfinite(result["psnr"])


def test_no_weights_are_fetched_where_lpips_scores_nothing(compose, tmp_path, monkeypatch):
    monkeypatch.delattr("ctm_plugin.runs.evaluate.load_lpips")
    assert "lpips" not in train(compose("+backbone=barf2d", *PATCHES), tmp_path)


def test_lom_trains_on_its_layout(compose, ball, tmp_path):
    """Frames in ``low`` to train on and in ``high`` to be scored against, each there twice."""
    root = tmp_path / "dark_ball"
    for folder in ("low", "high"):
        (root / folder).mkdir(parents=True)
    for split, listed in (("train", "low"), ("test", "high")):
        content = json.loads((ball / f"transforms_{split}.json").read_text())
        for frame in content["frames"]:
            picture = ball / f"{frame['file_path']}.png"
            for folder in ("low", "high"):
                shutil.copy(picture, root / folder / f"{split}_{picture.name}")
            frame["file_path"] = f"{listed}/{split}_{picture.name}"
            del frame["depth_file_path"]
        del content["depth_scale"]
        (root / f"transforms_{split}.json").write_text(json.dumps(content))
    config = compose("+experiment=lom", "dataset=transforms", f"dataset.root={root}")
    result = train(config, tmp_path / "run")
    assert result["steps"] > 0
    assert {"psnr", "psnr_lit", "ssim_lit"} <= {name for name, value in result.items() if value}


@pytest.mark.parametrize(
    ("background", "coarse"), [("black", "true"), ("white", "true"), ("random_matched", "true"), ("random", "false")]
)
def test_every_background_trains_in_both_stages(compose, tmp_path, background, coarse):
    result = train(compose(f"dataset.background={background}", f"backbone.coarse={coarse}"), tmp_path)
    assert result["steps"] == (32 if coarse == "true" else 20)
    assert (", white background" in result["protocol"]) == (background == "white")


def test_no_pretraining_in_a_short_run_is_warned_of(compose):
    def check(*overrides):
        config = compose("trainer=smoke", *overrides)
        warn_of_short_run(config, assemble(config))

    with pytest.warns(UserWarning, match="a run of 32 steps .* ctm=quick is made for short ones"):
        check("ctm=on")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check("ctm=quick")
        check("ctm=quick", "ctm.pretrain_steps=0")
        check("ctm=off")
        check("ctm=on", "backbone.steps=20000")


def test_sparse_gradients_change_nothing(compose, tmp_path, monkeypatch):
    """Clipping wants dense ones, and a bound that is never reached multiplies all by 1.

    To the bit: both are added up in one order and stepped by one loop, neither of which fuses anything.
    """
    seen = []
    monkeypatch.setattr(adam, "_rows_of", lambda grad, plain=adam._rows_of: seen.append(grad.shape) or plain(grad))
    settings = ("backbone.coarse=false", "backbone.steps_alone=6", "backbone.grow=[3]", "backbone.rays=16")
    settings += ("backbone.voxels=32768", "trainer.accelerator=cpu", "trainer.precision=32-true")
    weights = []
    for name, clip in (("sparse", "null"), ("dense", "1e9")):
        train(compose(*settings, f"trainer.gradient_clip_val={clip}"), tmp_path / name)
        weights.append(torch.load(tmp_path / name / LAST, weights_only=True)["state_dict"])
        assert bool(seen) == (name == "sparse")
        seen.clear()
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


def test_free_space_is_looked_for_whenever_the_steps_have_doubled(compose, tmp_path, monkeypatch):
    looks, steps = [], []
    monkeypatch.setattr(VoxelField, "update_occupancy", lambda field: looks.append(field))
    monkeypatch.setattr(DVGO, "renew_pool", lambda module: steps.append(module.global_step))
    sizes = ("backbone.steps_alone=20", "backbone.grow=[]", "backbone.occupancy_first=2", "trainer.image_every=null")
    train(compose("backbone.coarse=false", "ctm=off", *sizes), tmp_path / "run")
    assert steps == [0, 2, 4, 8, 16]  # the first as the training starts
    assert len(looks) == 4
