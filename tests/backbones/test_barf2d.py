"""Planar alignment: the task solved, its batches, its schedule, and runs that stop and go on."""

import json
import math

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from ctm_plugin import cli
from ctm_plugin.backbones.barf2d import BARF2D
from ctm_plugin.backbones.settings import BARF2DConfig
from ctm_plugin.data.planar import PATCH_DIRECTIONS, PlanarConfig, cut
from ctm_plugin.draws import Draws
from ctm_plugin.errors import ConfigError, Interrupted
from ctm_plugin.metrics.rendered import Alignment
from ctm_plugin.metrics.table import corner_errors
from ctm_plugin.rays.homography import pixel_grid
from ctm_plugin.runs.evaluate import evaluate
from ctm_plugin.runs.rundir import LAST, METRICS
from ctm_plugin.runs.train import resume, train
from ctm_plugin.scene.views import PlanarScene

SIZE = {"height": 30, "width": 40, "patch": 12}


@pytest.fixture(scope="module")
def painting(tmp_path_factory):
    """Soft spots of colour."""
    rng, grid = np.random.default_rng(3), pixel_grid(30, 40).numpy()
    spots = zip(rng.uniform(-1, 1, (30, 2)), rng.uniform(0.15, 0.3, 30), rng.uniform(-0.5, 0.5, (30, 3)), strict=True)
    light = sum(c * np.exp(-((grid - at) ** 2).sum(-1, keepdims=True) / (2 * size**2)) for at, size, c in spots)
    path = tmp_path_factory.mktemp("picture") / "spots.png"
    iio.imwrite(path, (255 * (0.5 + 0.4 * light).clip(0, 1)).round().astype(np.uint8))
    return path


@pytest.fixture
def scene(painting) -> PlanarScene:
    return PlanarConfig(image=painting, **SIZE).load()


@pytest.fixture
def overrides(painting) -> tuple[str, ...]:
    picture = ("dataset=planar", f"dataset.image={painting}", *(f"dataset.{k}={v}" for k, v in SIZE.items()))
    return ("backbone=barf2d", "backbone.steps=9", *picture)


# The task


@pytest.mark.slow
def test_translations_are_found(painting):
    loaded = PlanarConfig(image=painting, noise_h=0, noise_t=0.2, **(SIZE | {"patch": 16})).load()
    torch.testing.assert_close(loaded.true_warps[:, :2], 0.2 * PATCH_DIRECTIONS)
    # By whole pixels, so that patches hold the picture's own colours and an exact solution exists.
    assert torch.equal(loaded.clean, cut(loaded.image, loaded.true_warps, 16))
    config = BARF2DConfig(steps=1500, width=48, depth=2, frequencies=3, lr=5e-3, lr_warp=1e-2)
    module = BARF2D(config, loaded)
    optimizer = module.configure_optimizers()
    errors = []
    for step in range(config.steps):
        module.progress = step / config.steps
        for group in optimizer.param_groups:
            group["lr"] = group["initial_lr"] * min(1, 0.02 ** (2 * step / config.steps - 1))
        optimizer.zero_grad()
        module.training_step(None, step)["loss"].backward()
        optimizer.step()
        if step in (0, config.steps - 1):
            pictures = (loaded.clean, loaded.clean, loaded.image, loaded.image)
            found = corner_errors(Alignment(*pictures, module.warps.detach(), loaded.true_warps, 1.0))
            errors.append(found)
            assert found[0] == 0
    assert (errors[0][1:] > 5).all()
    assert errors[1].max() < 0.1


def test_the_first_patch_stays(scene):
    module = BARF2D(BARF2DConfig(steps=5), scene)
    module.training_step(None, 0)["loss"].backward()
    assert torch.equal(module.warps[0], torch.zeros(8))
    assert module.moved.grad.abs().sum() > 0
    assert sorted(module.configure_optimizers().members) == ["image", "warps"]


def test_patches_are_shifted_before_they_turn(scene):
    module = BARF2D(BARF2DConfig(steps=10, shifts_until=0.5), scene)
    optimizer = module.configure_optimizers()
    for step in range(7):
        module.progress = step / 10
        optimizer.zero_grad()
        module.training_step(None, step)["loss"].backward()
        optimizer.step()
        moved = (module.moved != 0).any(0)
        assert moved[:2].all()
        assert moved[2:].all() if step >= 5 else not moved[2:].any()


def test_all_but_shifts_decays_until_all_frequencies_are_in(scene):
    module = BARF2D(BARF2DConfig(lr_warp=1e-2, end=0.5, warp_decay=2.0), scene)
    torch.nn.init.ones_(module.moved)
    module.progress = 0.5
    module.decay_warps()
    assert (module.moved == 1).all()
    module.progress = 0.49
    module.decay_warps()
    torch.testing.assert_close(module.moved.detach(), torch.tensor([1.0] * 2 + [0.98] * 6).expand(4, -1))


def test_warps_decay_in_a_run(compose, overrides, tmp_path):
    """At a decay of 1 / lr a step begins at 0 again, and ends where a step of Adam's leads."""
    keys = ("ctm=off", "backbone.end=1", "backbone.lr_warp=0.01", "backbone.warp_decay=100")
    train(compose(*overrides, *keys), tmp_path)
    moved = torch.load(tmp_path / LAST, weights_only=True)["state_dict"]["moved"].abs()
    assert moved[:, :2].max() > 0.05
    assert 0 < moved[:, 2:].max() < 0.02


def test_all_starts_where_the_patches_are_not_moved(scene):
    module = BARF2D(BARF2DConfig(), scene)
    torch.testing.assert_close(module.moved_points(module.grid), pixel_grid(30, 40, 12).flatten(0, 1).expand(5, -1, -1))


def test_true_homographies_and_a_true_picture_have_no_loss(scene):
    """A network that knows the picture sees exactly the patches."""
    module = BARF2D(BARF2DConfig(), scene)
    module.moved.data = scene.true_warps[1:]
    grid = module.moved_points(module.grid).detach().view(5, 12, 12, 2) * torch.tensor([1, 40 / 30])
    pictures = scene.image.permute(2, 0, 1).expand(5, -1, -1, -1)
    seen = torch.nn.functional.grid_sample(pictures, grid, align_corners=False).permute(0, 2, 3, 1)
    torch.testing.assert_close(seen, scene.clean)


# Batches


def test_all_pixels_by_default(scene):
    module = BARF2D(BARF2DConfig(), scene)
    batch = module.draw(Draws(0, 0))
    assert torch.equal(batch.rgb.view(5, 12, 12, 3), scene.patches)
    assert module.predict(batch, Draws(0, 0)).latent.shape == (5 * 144, 3)
    assert module.batch_rays == 720


def test_processes_share_the_pixels(scene):
    module = BARF2D(BARF2DConfig(), scene)
    shares = [module.draw(Draws(0, 0, rank=rank, world=2)) for rank in range(2)]
    together = torch.cat([share.rgb.view(5, 72, 3) for share in shares], dim=1)
    assert torch.equal(together.view(5, 12, 12, 3), scene.patches)
    assert all(share.pixel.shape == (5, 72) for share in shares)


def test_some_pixels_a_step(scene):
    module = BARF2D(BARF2DConfig(pixels=50), scene)
    batches = [module.draw(Draws(0, step)) for step in range(2)]
    for batch in batches:
        assert batch.pixel.shape == (5, 10)
        expected = [scene.patches[p].flatten(0, 1)[i] for p in range(5) for i in batch.pixel[p]]
        assert torch.equal(batch.rgb, torch.stack(expected))
    assert not torch.equal(batches[0].pixel, batches[1].pixel)
    # The same pixels are asked of the network.
    every = module.predict(module.draw(Draws(0, 0)), Draws(0, 0)).latent.view(5, 10, 3)
    whole = module.latent_at(module.moved_points(module.grid).flatten(0, 1)).view(5, 144, 3)
    torch.testing.assert_close(every, whole.gather(1, batches[0].pixel[..., None].expand(-1, -1, 3)))


@pytest.mark.parametrize("encoding", ["none", "naive", "barf"])
def test_encodings(scene, encoding):
    module = BARF2D(BARF2DConfig(encoding=encoding, frequencies=4), scene)
    points = torch.rand(6, 2)
    columns = module.image.layers[0].weight.shape[1]
    assert columns == (2 if encoding == "none" else 18)
    before = module.latent_at(points)
    module.progress = 1.0
    assert torch.equal(before, module.latent_at(points)) == (encoding != "barf")


def test_patches_and_picture_are_rendered_alike(scene):
    module = BARF2D(BARF2DConfig(), scene)
    assert module.render_image().shape == (30, 40, 3)
    torch.testing.assert_close(module.render_patches()[0], module.render_image()[9:21, 14:26])


def test_stats(scene):
    module = BARF2D(BARF2DConfig(), scene)
    assert module.stats() == {"warp_error": pytest.approx(scene.true_warps.norm(dim=1).mean().item())}


def test_frequencies_come_in_until_after_they_began():
    found = "backbone.end: found 0.5, expected a number from above backbone.start, 0.5, to 1"
    with pytest.raises(ConfigError, match=found):
        BARF2DConfig(start=0.5, end=0.5)


@pytest.mark.parametrize("pixels", [7, 725])
def test_pixels_that_the_patches_do_not_have(scene, pixels):
    with pytest.raises(ConfigError, match=f"backbone.pixels: found {pixels}, expected a multiple of 5, at most 720"):
        BARF2D(BARF2DConfig(pixels=pixels), scene)


# Runs


@pytest.mark.parametrize("pixels", ["100", pytest.param("null", marks=pytest.mark.slow)])
def test_an_interrupted_run_ends_as_a_whole_one(compose, overrides, tmp_path, ctrl_c, pixels):
    config = compose(*overrides, f"backbone.pixels={pixels}")
    train(config, tmp_path / "whole")
    ctrl_c(lambda seen: seen == 4)
    with pytest.raises(Interrupted):
        train(config, tmp_path / "run")
    resume(tmp_path / "run")
    whole, again = (torch.load(tmp_path / name / LAST, weights_only=True) for name in ("whole", "run"))
    assert whole["progress"] == again["progress"] == 8 / 9
    for name, value in whole["state_dict"].items():
        assert torch.equal(value, again["state_dict"][name]), name
    scores = [json.loads((tmp_path / name / METRICS).read_text()) for name in ("whole", "run")]
    for key in ("warp_error", "psnr", "corner_error"):
        assert scores[0][key] == scores[1][key]


def test_a_run_directory(compose, overrides, tmp_path):
    result = train(compose(*overrides, "dataset.exposure=0.1"), tmp_path)
    names = {path.stem for path in (tmp_path / "lit").iterdir()}
    assert names == {"warps", "patches", "fused", "latent"}
    assert result["dataset"] == "spots"
    assert len(result["per_patch"]) == 5
    assert result["per_patch"][0]["warp_error"] == 0
    assert result["warp_error"] == pytest.approx(np.mean([row["warp_error"] for row in result["per_patch"]]))
    assert result["psnr"] == pytest.approx(np.mean([row["psnr"] for row in result["per_patch"]]))
    assert "exposure 0.1" in result["protocol"]
    again = evaluate(tmp_path)
    assert all(again[key] == result[key] for key in ("warp_error", "psnr", "image_psnr"))


@pytest.mark.slow
@pytest.mark.parametrize("space", ["rgb", "lab", "hsv_cart", "log"])
@pytest.mark.parametrize("ctm", ["off", "on"])
def test_colour_spaces(compose, overrides, tmp_path, space, ctm):
    config = compose(*overrides, f"color_space={space}", f"+ctm={ctm}" if ctm == "off" else "ctm.k=2")
    assert math.isfinite(train(config, tmp_path)["warp_error"])


@pytest.mark.slow
def test_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small = ["trainer=smoke", "backbone.steps=2", "hydra.run.dir=run"]
    with pytest.warns(UserWarning, match=r"coffee\.png: scaled from 600x400 and cut to 480x360"):
        assert cli.main(["+backbone=barf2d", "+ctm=on", *small]) == 0
    assert "warping error" in capsys.readouterr().out
    assert (tmp_path / "run" / "lit" / "warps.png").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["backbone=barf2d", "dataset=still_life"], "dataset: found 'still_life', expected a data set that backbone"),
        (["backbone=dvgo", "dataset=planar"], "dataset: found 'planar', expected a data set that backbone=dvgo can"),
        (["backbone=nerf", "dataset=planar"], "dataset: found 'planar', expected a data set that backbone=nerf can"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*scaled from")
def test_a_data_set_of_another_kind(arguments, message, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in refused(*arguments, "trainer=smoke", "hydra.run.dir=run")
