"""Splats: their constants meet colours as they are encoded; checkpoints, processes, whole runs."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import ddp_rank
import pytest
import torch
import torch.nn.functional as F
from faults import checkpoint
from forked import Command
from splat_runs import GROWS, SPLAT, make, stepped
from torch import Tensor

import ctm_plugin
from ctm_plugin.backbones.splat import Splat
from ctm_plugin.color.dssim import dssim
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.errors import CheckpointError, CTMError
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.evaluate import evaluate
from ctm_plugin.runs.load import load_posed
from ctm_plugin.runs.rundir import LAST
from ctm_plugin.runs.train import resume, train
from ctm_plugin.scene.views import Scene, Views
from ctm_plugin.splats.render import bends


@pytest.fixture(scope="module")
def scene(ball) -> Scene:
    return BlenderConfig(root=ball).load()


@pytest.mark.slow
def test_pictures_with_more_pixels_have_no_gaps(scene, monkeypatch):
    """Of specks far below a pixel, twice as wide pictures, averaged, are the pictures of the training's size."""
    module, views = make(scene), scene.test
    with torch.no_grad():
        module.tables["scales"].fill_(math.log(1e-5))
    blank = views.images.new_zeros(1, 2 * views.height, 2 * views.width, views.images.shape[-1])
    finer = Views(blank, views.c2w[:1], 2 * views.intrinsics[:1], ("finer",))

    def differs() -> float:
        with torch.no_grad():
            opacity = module.render_view(finer, 0)["opacity"][None, None]
            expected = module.render_view(views, 0)["opacity"]
        assert expected.max() > 0.05
        return float((F.avg_pool2d(opacity, 2)[0, 0] - expected).abs().mean() / expected.mean())

    assert differs() < 0.3  # a training view may be nearer, which wants less
    monkeypatch.setattr(module, "_without_gaps", lambda camera: module.gaussians)
    assert differs() > 0.5


def test_rates_are_those_of_the_configuration(scene):
    module = make(scene, lr_means=1e-3, lr_scales=2e-3, lr_quats=3e-3, lr_sh0=4e-3, lr_opacities=5e-3, lr_rest=0.5)
    rates = {each["name"]: each["lr"] for part in module.field_optimizers().values() for each in part.param_groups}
    own = {"scales": 2e-3, "quats": 3e-3, "sh0": 4e-3, "opacities": 5e-3, "shN": 2e-3}
    assert rates == pytest.approx(own | {"means": 1e-3 * module.extent})


def gradients(module: Splat) -> dict[str, Tensor]:
    return {name: table.grad for name, table in module.tables.items()}


# The loss


@pytest.mark.parametrize("share", [0.0, 0.2, 0.7])
def test_absolute_differences_and_dissimilarity(scene, share):
    """Of colours that fill [0, 1], whatever range they fill; the loss's own weight is on the first alone."""
    module = make(scene, dssim=share, weight=2.0, degree=0)
    draws = module.draws(0)
    batch = module.draw(draws)
    (rendered,) = module.predict(batch, draws).pictures
    v = (rendered.latent - module.low) / module.range
    wanted = ((batch.rgb - module.low) / module.range).view(12, 12, 3)
    terms = stepped(module)
    torch.testing.assert_close(terms["color"], 2 * (1 - share) * (v - wanted).abs().mean().detach())
    if share:
        expected = share * dssim.reference(v.double().permute(2, 0, 1), wanted.double().permute(2, 0, 1))
        torch.testing.assert_close(terms["dssim"], expected.detach().float(), atol=1e-6, rtol=1e-5)
    assert ("dssim" in terms) == (share > 0)


def test_squared_differences_leave_dissimilarity_out(compose, scene):
    terms = stepped(make(scene, kind="mse"))
    assert terms.keys() == {"color"}
    for loss, kind in (("auto", "l1"), ("l1", "l1"), ("mse", "mse")):
        assert assemble(compose(*SPLAT, f"loss={loss}", "ctm=off")).backbone.photometric.kind == kind
    other = assemble(compose(*SPLAT, "backbone.photometric=mse", "ctm=off")).backbone
    assert (other.photometric.kind, other.dssim) == ("mse", 0)


@pytest.mark.slow
def test_opacity_size_and_bends_cost_what_they_weigh(scene):
    module = make(scene, opacity=0.3, size=0.7, bend=0.2, views=2)
    draws = module.draws(0)
    batch = module.draw(draws)
    expected = [
        bends(inverse, seen.opacity, (seen.latent - module.low) / module.range)
        for seen, inverse in zip(module.predict(batch, draws).pictures, module.depths, strict=True)
    ]
    terms = stepped(module)
    assert terms["bend"].item() == pytest.approx(0.2 * sum(expected).item() / 2)
    tables = module.gaussians
    assert terms["opacity"].item() == pytest.approx(0.3 * tables.opacities.sigmoid().mean().item())
    assert terms["size"].item() == pytest.approx(0.7 * tables.scales.exp().mean().item() / module.extent)


@pytest.mark.parametrize("views", [1, 2])
def test_what_masked_pixels_show_changes_nothing(scene, views):
    """Where Gaussians begin, how the colours are scaled, the loss with D-SSIM, its gradients, the light factor."""
    train, found = scene.train, []
    mask = torch.ones(8, 12, 12, dtype=torch.bool)
    mask[:, 2:5, 3:9] = False
    mask[3] = False
    for shown in (0, 255):
        images = torch.where(mask[..., None], train.images, torch.full_like(train.images, shown))
        images[..., 3] = train.images[..., 3]
        masked = dataclasses.replace(scene, train=dataclasses.replace(train, images=images, mask=mask))
        module = make(masked, views=views)
        terms = stepped(module)
        found.append([module.low, module.range, module.light.gain, terms, gradients(module), module.grad2d])
    assert found[0][:3] == found[1][:3]
    for one, other in zip(found[0][3:5], found[1][3:5], strict=True):
        assert one.keys() == other.keys()
        assert all(torch.equal(one[name], other[name]) for name in one)
    assert torch.equal(found[0][5], found[1][5])
    assert found[0][3]["dssim"] > 0


# Constants meet the same colours


def test_the_range_is_that_of_the_encoded_colours(compose):
    for space in ("rgb", "log"):
        parts = assemble(compose(*SPLAT, f"color_space={space}", "ctm=off", "dataset.exposure=0.05"))
        module = parts.backbone
        colors = module.some_colors()
        parts.backbone.transform.begin(colors)
        module.on_train_start()
        encoded = parts.backbone.transform.encode(colors)
        v = (encoded - module.low) / module.range
        inside = ((v > -1e-3) & (v < 1.001)).float().mean()
        assert inside > 0.99
        assert v.amax() > 0.9
        assert module.photometric.weight == pytest.approx(0.8 / module.range)
        weight = module.photometric.weight
        module.batches_seen = 1  # a run that goes on: nothing is found anew
        module.set_range(module.low, module.range)
        module.on_train_start()
        assert module.photometric.weight == pytest.approx(weight)


def test_the_first_colours_are_the_pictures(scene):
    """Before any step, as they are rendered."""
    module = make(scene)
    seen = 0.5 + 0.28209479 * module.gaussians.sh0
    torch.testing.assert_close(module.low + module.range * seen.detach(), module.first_colors, atol=1e-5, rtol=0)


@pytest.mark.parametrize("relative", [True, False])
def test_rgb_and_a_gain_pull_alike(compose, relative):
    """In the dark, where a gain of ten or so is found; unless constants are taken as they are."""
    modules = []
    for space in ("rgb", "gain"):
        dark = ("dataset.exposure=0.02", "dataset.background=black", f"backbone.relative={str(relative).lower()}")
        parts = assemble(compose(*SPLAT, "ctm=off", f"color_space={space}", *dark))
        module, transform = parts.backbone, parts.backbone.transform
        transform.begin(module.some_colors())
        module.on_train_start()
        stepped(module)
        modules.append(module)
    one, other = modules
    seen = one.grad2d_count > 0
    assert torch.equal(seen, other.grad2d_count > 0)
    factor = (other.grad2d / one.grad2d)[seen].median().item()
    first = (one.gaussians.sh0 - other.gaussians.sh0).abs().max().item()
    if relative:
        torch.testing.assert_close(one.grad2d, other.grad2d, atol=1e-6, rtol=1e-3)
        assert first < 1e-4
    else:
        assert factor > 2
        assert first > 0.1


# Checkpoints


def spoilt_low(saved: dict[str, Any]) -> None:
    saved["splat"]["low"] = math.nan


def spoilt_range(saved: dict[str, Any]) -> None:
    saved["splat"]["range"] = 0.0


def without_numbers(saved: dict[str, Any]) -> None:
    del saved["splat"]


def shorter(saved: dict[str, Any]) -> None:
    saved["state_dict"]["tables.quats"] = saved["state_dict"]["tables.quats"][:-1]


def without_statistics(saved: dict[str, Any]) -> None:
    saved["state_dict"]["grad2d"] = saved["state_dict"]["grad2d"][:-1]


def no_number(saved: dict[str, Any]) -> None:
    saved["state_dict"]["tables.means"][0, 0] = math.nan


@pytest.mark.parametrize(
    "spoil",
    [spoilt_low, spoilt_range, without_numbers, shorter, without_statistics, no_number],
    ids=lambda f: f.__name__,
)
def test_checkpoints_that_cannot_be(grown, tmp_path, spoil):
    _, whole = grown
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "config.yaml").write_bytes((whole / "config.yaml").read_bytes())
    saved = checkpoint(whole)
    spoil(saved)
    torch.save(saved, tmp_path / LAST)
    for read in (evaluate, load_posed, resume):
        with pytest.raises(CheckpointError, match="found weights that do not fit"):
            read(tmp_path)


# Pictures


def test_evaluation_is_deterministic_and_bf16_changes_nothing(grown):
    """Of the rendering: a step's loss in bf16 is that in float32, as the picture is never rounded."""
    module = load_posed(grown[1]).module
    views = module.scene.test
    one, other = module.render_view(views, 0), module.render_view(views, 0)
    with torch.autocast("cpu", torch.bfloat16):
        half = module.render_view(views, 0)
    for name, picture in one.items():
        assert torch.equal(picture, other[name])
        assert torch.equal(picture, half[name]), name
        assert picture.dtype == torch.float32


@pytest.mark.parametrize("loops", [True, False])
def test_a_step_in_bf16_is_one_in_float32(scene, monkeypatch, loops):
    """D-SSIM's variances are differences of nearly equal numbers."""
    if not loops:
        monkeypatch.setattr("ctm_plugin.door.may_run", lambda _: False)
    found = []
    for half in (False, True):
        module = make(scene)
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            loss = module.training_step(None, 0)["loss"]
        loss.backward()
        found.append([*module.terms.values(), *gradients(module).values()])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, atol=0, rtol=0)


def test_what_dashboards_are_told(grown):
    module = load_posed(grown[1]).module
    assert module.stats() == {"gaussians": float(len(module.gaussians.means))}
    assert {"test/depth"} < module.snapshot(0).pictures.keys()
    assert 2 < float(module.render_view(module.scene.test, 0)["depth"].min()) < 6
    with pytest.raises(CTMError, match="Splat has no method query"):
        module.query(torch.zeros(1, 3), torch.zeros(1, 3))


# Runs


SPACES = ["log", "hsv_cart", "lab"]


@pytest.mark.parametrize(
    "chosen",
    [
        *(pytest.param(("ctm=off", f"color_space={space}"), marks=pytest.mark.slow) for space in SPACES),
        pytest.param(("ctm=on",), marks=pytest.mark.slow),
        pytest.param(("ctm=quick", "color_space=gain"), marks=pytest.mark.slow),
        ("ctm=auto",),
        ("ctm=on", "ctm.k=5", "loss=mse"),
        ("ctm=quick", "appearance=exposure", "backbone.bend=0.1", "trainer.accumulate_grad_batches=2"),
        ("ctm=off", "appearance=exposure", "dataset.background=white"),
        ("ctm=off", "dataset.background=random", "backbone.degree=3", "backbone.opacity=0.01", "backbone.dssim=0.9"),
        ("ctm=off", "backbone.relative=false", "backbone.dssim=0", "trainer.precision=bf16-mixed"),
    ],
    ids=" ".join,
)
def test_it_trains_through_everything(compose, tmp_path, chosen):
    pretrained = ("ctm.pretrain_steps=20",) if {"ctm=on", "ctm=quick"} & {*chosen} else ()
    small = ("dataset.exposure=0.1", "backbone.steps=7", "backbone.grow_every=2", "backbone.grow_from=2")
    scores = train(compose(*SPLAT, *GROWS, *small, *pretrained, *chosen), tmp_path)
    assert math.isfinite(scores["psnr"])
    assert scores["steps"] == 7
    saved = checkpoint(tmp_path)
    assert len(saved["state_dict"]["tables.means"]) > 200
    learned = any("ctm=" in each and each not in ("ctm=off", "ctm=auto") for each in chosen)
    assert ("ctm" in saved["optimizer_states"][0]) == learned
    assert evaluate(tmp_path)["psnr"] == scores["psnr"]


LEARNS = ("steps=90", "grow_from=30", "grow_every=30", "grow_until=60", "reset_every=0", "lr_means=1e-3")


def test_training_learns(compose, tmp_path):
    config = compose(*SPLAT, "ctm=off", *(f"backbone.{size}" for size in LEARNS), "backbone.first=400")
    result = train(config, tmp_path)
    assert result["converged"]
    assert result["psnr"] > result["constant_psnr"] + 5


def test_a_capture_through_lenses(compose, hall, tmp_path, monkeypatch):
    """Forward-facing, through lenses."""
    scene = assemble(compose("dataset=llff", f"dataset.root={hall}", "backbone=splat", "ctm=off")).scene
    lens = torch.tensor([[-0.1, 0.02, 0.001, 0.0, 0.0]])
    train_, test = (
        dataclasses.replace(views, distortion=lens.repeat(len(views), 1)) for views in (scene.train, scene.test)
    )
    monkeypatch.setattr(
        "ctm_plugin.runs.assemble.load_scene", lambda *_: dataclasses.replace(scene, train=train_, test=test)
    )
    learns = (f"backbone.{size}" for size in LEARNS)
    config = compose("dataset=llff", f"dataset.root={hall}", *SPLAT, "ctm=off", *learns)
    result = train(config, tmp_path)
    assert result["psnr"] > result["constant_psnr"] + 1


@pytest.mark.slow
def test_two_processes_step_as_one(arguments, compose, tmp_path):
    """With a view each, through growth and a reset."""
    more = (*SPLAT, *GROWS, "backbone.views=2", "ctm=off", "dataset.background=random_matched", "backbone.steps=12",
            "trainer.accelerator=cpu", "trainer.precision=32-true", "backbone.dssim=0")  # fmt: skip
    command = (str(tmp_path), *arguments, *more, "trainer.devices=2", f"hydra.run.dir={tmp_path / 'two'}")
    where = {"PYTHONPATH": str(Path(ctm_plugin.__file__).parents[1])}
    process = Command(*command, told=tmp_path / "told", main=ddp_rank.main, **where)
    _, error = process.communicate()
    assert process.returncode == 0, error
    steps = torch.load(tmp_path / "rank0.pt", weights_only=True)["steps"]
    assert len(steps) == 12
    assert len({len(step["state_dict"]["tables.means"]) for step in steps}) > 1
    # At first all are round: the gradient of their turns is nothing but rounding.
    assert max(ddp_rank.apart(compose(*more), [step]) for step in steps[1:]) < ddp_rank.APART
    assert checkpoint(tmp_path / "two")["state_dict"]["grad2d_count"].sum() > 0
