"""Backbones that render whole pictures: which views a step is, what it compares, and another package's rasteriser."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from faults import checkpoint, differences
from torch import Tensor, nn

from ctm_plugin.backbones.pictures import PictureBackbone, RenderedView
from ctm_plugin.compose.command_line import compose as composed_anew
from ctm_plugin.draws import Draws
from ctm_plugin.errors import Interrupted
from ctm_plugin.runs.assemble import Parts, assemble
from ctm_plugin.runs.evaluate import evaluate
from ctm_plugin.runs.load import load_posed
from ctm_plugin.runs.train import resume, train
from ctm_plugin.scene.views import composite
from ctm_plugin.settings.registry import BACKBONES

SIDE = 12
PIXELS = SIDE * SIDE


@dataclass(frozen=True, kw_only=True)
class SheetConfig:
    steps: int = 6
    views: int = 1


class Sheet(PictureBackbone):
    """What a plug-in author writes: a coarse picture before every camera, half transparent, that trembles in training.

    All but the rasteriser is the base class's.
    """

    Config = SheetConfig

    def __init__(self, config, scene, transform=None, photometric=None, seed=0):
        super().__init__(scene, config.views, transform, photometric, seed)
        self.total_steps = config.steps
        self.sheet = nn.Parameter(torch.zeros(1, self.channels, 4, 4))

    def field_optimizers(self):
        return {"sheet": torch.optim.Adam([self.sheet], 0.05)}

    def render(self, views, index, background, draws, every=1):
        shift = 0.0 if draws is None else 0.01 * (draws.uniform(1, self.channels)[0, :, None, None] - 0.5)
        size = views.height, views.width
        whole = F.interpolate(self.sheet.sigmoid() + shift, size, mode="bilinear")[0].permute(1, 2, 0)
        latent = (0.5 * whole + 0.5 * background)[::every, ::every]
        half = torch.full_like(latent[..., 0], 0.5)
        return RenderedView(latent, half, None if draws else half * (1 + self.scene.far))


@pytest.fixture
def sheet(ball, monkeypatch) -> Callable[..., dict[str, Any]]:
    """The configuration of a command line that names another package's backbone."""
    monkeypatch.setitem(BACKBONES.added, "sheet", Sheet)
    small = ("dataset=blender", f"dataset.root={ball}", "trainer=smoke", "backbone=sheet", "trainer.image_every=null")
    return lambda *more: composed_anew(*small, *more)


@pytest.fixture
def parts(sheet) -> Callable[..., Parts]:
    def made(*more: str) -> Parts:
        return assemble(sheet("ctm=off", *more))

    return made


def steps(module: Sheet, count: int) -> list[Any]:
    """The batches of the first steps."""
    batches = []
    for step in range(count):
        module.batches_seen = step + 1
        batches.append(module.draw(module.draws(step)))
    return batches


# Which views


@pytest.mark.parametrize("views", [1, 3])
def test_each_pass_has_each_view_once(parts, views):
    module = parts(f"backbone.views={views}").backbone
    seen = [view for batch in steps(module, 8) for view in batch.views]
    assert all(len(batch.views) == views for batch in steps(module, 2))
    passes = [seen[begin : begin + 8] for begin in range(0, 8 * views, 8)]
    assert all(sorted(each) == list(range(8)) for each in passes)
    assert seen != sorted(seen)
    if views > 1:
        assert passes[0] != passes[1]


def test_the_order_is_of_the_seed(parts):
    orders = [[batch.views for batch in steps(parts(f"seed={seed}").backbone, 16)] for seed in (0, 0, 1)]
    assert orders[0] == orders[1] != orders[2]
    assert orders[0][:8] != orders[0][8:]


def test_processes_share_the_views_that_one_would_train_on(parts):
    module = parts("backbone.views=4", "dataset.background=random_matched").backbone
    module.batches_seen = 2
    whole = module.draw(Draws(0, 1))
    shares = [module.draw(Draws(0, 1, "cpu", rank, 2)) for rank in (0, 1)]
    assert whole.views == (*shares[0].views, *shares[1].views)
    assert torch.equal(whole.rgb, torch.cat([share.rgb for share in shares]))
    assert torch.equal(
        torch.cat(whole.backgrounds), torch.cat([each for share in shares for each in share.backgrounds])
    )


# What is compared


def test_a_batch_is_the_pixels_of_its_views_row_by_row(parts):
    found = parts("backbone.views=2", "dataset.background=white")
    module, (batch, *_) = found.backbone, steps(found.backbone, 1)
    assert batch.counted is None
    assert batch.rgb.shape == (2 * PIXELS, 3)
    for at, view in enumerate(batch.views):
        expected = composite(found.scene.train.images[view], torch.ones(3)).flatten(0, 1)
        assert torch.equal(batch.rgb[at * PIXELS : (at + 1) * PIXELS], expected)
    place = module.place(batch.pixel, batch.rgb)
    assert place.view.tolist() == [batch.views[0]] * PIXELS + [batch.views[1]] * PIXELS
    assert torch.equal(place.at[5], torch.tensor([5.5, 0.5]) / SIDE)
    rendering = module.predict(batch, Draws(0, 0))
    assert rendering.latent.shape == batch.rgb.shape
    assert torch.equal(rendering.latent[:PIXELS], rendering.pictures[0].latent.flatten(0, 1))
    assert module.batch_rays == 2 * PIXELS


@pytest.mark.parametrize("ctm", ["off", "quick"])
@pytest.mark.parametrize("background", ["black", "white", "random", "random_matched"])
def test_backgrounds_are_one_colour_a_view(sheet, background, ctm):
    """The same behind the picture and under the rendering; of random ones every fourth is that of evaluation."""
    parts = assemble(sheet(f"ctm={ctm}", f"dataset.background={background}", "dataset.exposure=0.2"))
    module, images = parts.backbone, parts.scene.train.images
    transform = module.transform
    transform.begin(module.scene_colors(Draws(0, 0), 1000))
    colours = []
    for batch in steps(module, 12):
        ((view,), (latent,)) = batch.views, batch.backgrounds
        clear = images[view, ..., 3].flatten() == 0
        assert clear.sum() > 20
        colour = batch.rgb[clear]
        assert (colour == colour[0]).all()
        assert latent.shape == (1, 3)
        if background != "random":
            torch.testing.assert_close(latent, transform.encode(colour[:1]))
        colours.append(torch.cat([colour[0], latent[0]]))
    seen = torch.stack(colours)
    constant = float(background == "white")
    if background in ("black", "white"):
        assert (seen[:, :3] == constant).all()
        assert (seen == seen[0]).all()
    elif background == "random_matched":
        assert not seen[::4, :3].any()
        assert all(seen[number, :3].any() for number in range(12) if number % 4)
    else:
        assert not seen[:, :3].any()
    if background.startswith("random"):
        assert len(seen[:, 3:].unique(dim=0)) == (10 if background == "random_matched" else 12)


def test_masked_pixels_are_in_no_batch(parts):
    """A picture's own count of pixels, so that what they show changes neither the loss nor its gradient."""
    found = parts("backbone.views=2", "dataset.background=black")
    views, gradients = found.scene.train, []
    mask = torch.rand(views.images.shape[:3], generator=torch.Generator().manual_seed(0)) < 0.6
    for masked in (0, 255):
        images = torch.where(mask[..., None], views.images, torch.full_like(views.images, masked))
        scene = replace(found.scene, train=replace(views, images=images, mask=mask))
        module = Sheet(SheetConfig(views=2), scene)
        (batch,) = steps(module, 1)
        assert len(batch.rgb) == mask[list(batch.views)].sum()
        assert mask.flatten()[batch.pixel].all()
        for view, counted in zip(batch.views, batch.counted, strict=True):
            assert torch.equal(counted, mask[view].flatten().nonzero().squeeze(1))
        rendering = module.predict(batch, Draws(0, 0))
        first = mask[batch.views[0]]
        assert torch.equal(rendering.latent[: first.sum()], rendering.pictures[0].latent[first])
        out = module.training_step(None, 0)
        out["loss"].backward()
        gradients.append((out["loss"].detach(), module.sheet.grad))
    assert torch.equal(gradients[0][0], gradients[1][0])
    assert torch.equal(gradients[0][1], gradients[1][1])


# Whole runs of another package's


@pytest.mark.parametrize("more", [("ctm=quick", "ctm.pretrain_steps=20"), ("ctm=off", "color_space=log")])
def test_it_trains_scores_and_resumes(sheet, tmp_path, ctrl_c, more):
    config = sheet(*more, "appearance=exposure", "backbone.steps=10", "trainer.accumulate_grad_batches=2")
    scores = train(config, tmp_path / "whole")
    assert {"psnr", "ssim", "lit_psnr"} & scores.keys()
    assert scores["steps"] == 10
    states = checkpoint(tmp_path / "whole")["optimizer_states"][0]
    assert sorted(states) == sorted(["appearance", "sheet", *(["ctm"] if "ctm=quick" in more else [])])
    again = evaluate(tmp_path / "whole")
    assert again["psnr"] == scores["psnr"]
    ctrl_c(lambda seen: seen == 5)
    with pytest.raises(Interrupted):
        train(config, tmp_path / "run")
    ctrl_c(lambda seen: False)
    resume(tmp_path / "run")
    assert differences(tmp_path / "run", tmp_path / "whole") == []


def test_views_are_what_everybody_asks_for(sheet, tmp_path):
    """Every third row and column too, and what dashboards and clocks take."""
    train(sheet("ctm=off"), tmp_path)
    module = load_posed(tmp_path).module
    views = module.scene.test
    whole, part = (module.render_view(views, 0, every) for every in (1, 3))
    for name, shape in {"rgb": (12, 12, 3), "latent": (12, 12, 3), "depth": (12, 12), "opacity": (12, 12)}.items():
        assert whole[name].shape == shape
        assert torch.equal(whole[name][::3, ::3], part[name])
    snapshot = module.snapshot(0)
    assert {"test/depth"} < snapshot.pictures.keys()
    assert isinstance(whole["rgb"], Tensor)
    assert (Path(tmp_path) / "depth" / "r_0.png").exists()
