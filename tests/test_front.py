"""``import ctm_plugin as ctm`` in a program that trains by itself."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import ctm_plugin as ctm
from ctm_plugin.backbones.nerf import NeRF
from ctm_plugin.errors import ConfigError, CTMError
from ctm_plugin.scene.poses import IDENTITY


def test_it_takes_no_torch_until_asked():
    done = "import sys, ctm_plugin as ctm; dir(ctm); assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", done], check=True)
    assert {*ctm.FRONT} <= {*dir(ctm)}
    with pytest.raises(AttributeError, match="no attribute 'transfrom'"):
        ctm.transfrom  # noqa: B018


@pytest.mark.parametrize("name", ["auto", "quick", "on", "off", "log"])
def test_a_loop_of_plain_torch_learns_a_dark_picture_in_any_colours(name):
    picture = 0.04 * torch.rand(64, 3, generator=torch.Generator().manual_seed(0))
    transform = ctm.transform(name, *["ctm.pretrain_steps=100"] * (name == "quick"))
    own = ctm.fit(transform, picture.repeat(64, 1))
    field = torch.nn.Parameter(torch.zeros(64, transform.channels))
    with torch.no_grad():
        field += transform.encode(picture).mean(0).logit(eps=1e-3)
    optimizers = [torch.optim.Adam([field], 0.05), *([own] if own else [])]
    assert (own is not None) == (name in ("quick", "on"))
    before = (transform.decode(field.sigmoid()) - picture).square().mean()
    for _ in range(200):
        for optimizer in optimizers:
            optimizer.zero_grad()
        sum(ctm.losses(transform, field.sigmoid(), picture).values()).backward()
        for optimizer in optimizers:
            optimizer.step()
    assert (transform.decode(field.sigmoid()) - picture).square().mean() < before / 4


def test_what_is_chosen_is_what_the_command_line_chooses():
    assert ctm.transform().label == "ctm=auto"
    assert isinstance(ctm.transform(), ctm.Auto)
    learned = ctm.transform("on", "ctm.k=4", "ctm.lr=1e-3")
    assert isinstance(learned, ctm.CTM)
    assert (learned.channels, learned.learning.lr) == (4, 1e-3)
    assert ctm.fit(learned, torch.rand(99, 3)).defaults["lr"] == 1e-3


def test_seeds_make_networks_alike():
    first, again, other = (ctm.transform("on", seed=seed).state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(first[key], again[key]) for key in first)
    assert not all(torch.equal(first[key], other[key]) for key in first)


def test_what_cannot_be_used_is_refused():
    with pytest.raises(ConfigError, match=r"transform: found 'onn', expected one of auto, off, on, .*lab"):
        ctm.transform("onn")
    with pytest.raises(ConfigError, match=r"transform: found 'seed=3', expected settings"):
        ctm.transform("on", "seed=3")
    with pytest.raises(CTMError, match=r"ctm\.kk"):
        ctm.transform("on", "ctm.kk=3")
    with pytest.raises(ConfigError, match=r"ctm\.lr_decay: found 0\.5, expected 1"):
        ctm.fit(ctm.transform("on", "ctm.lr_decay=0.5"), torch.rand(9, 3))
    with pytest.raises(CTMError, match="nowhere"):
        ctm.load_run("nowhere")


@pytest.mark.slow
def test_a_run_is_looked_at_from_any_camera(splat_run):
    run = ctm.load_run(splat_run)
    views, world = run.module.scene.test, run.module.scene.world or IDENTITY
    (pose,), lens = world.inverse().of_poses(views.c2w[:1].double().numpy()), views.intrinsics[0].tolist()
    seen = run.render(pose, lens, views.width, views.height, kind="rgb")
    with torch.no_grad():
        expected = run.module.render_view(views, 0)["rgb"].float()
    torch.testing.assert_close(seen, expected, atol=1e-3, rtol=0)
    assert torch.equal(run.render(pose, lens, views.width, views.height), run.light.apply(seen))
    shown = run.gaussians()
    assert shown.sh0.shape == shown.means.shape == run.module.gaussians.means.shape
    other = replace(run, parts=replace(run.parts, backbone=NeRF.__new__(NeRF)))
    with pytest.raises(CTMError, match="found a run of NeRF, expected one of splats"):
        other.gaussians()


@pytest.mark.slow
def test_the_page_s_lines_train_splats_in_the_loop_of_gsplat_s_own_trainer():
    """A rasteriser of flat Gaussians, an Adam for each of their tables, a scheduler: ``examples/simple_trainer.py``."""
    page = Path(__file__).parents[1].joinpath("docs/plug_in.md").read_text(encoding="utf-8")
    first, fitting, comparing, decoding = re.search(
        r"## A trainer of your own.*?```python\n(.*?)```", page, re.S
    )[1].splitlines()  # fmt: skip
    torch.manual_seed(0)
    axis, max_steps = torch.linspace(0, 1, 24), 150
    pixels = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), dim=-1).flatten(0, 1)
    dark = 0.04 * torch.stack([pixels[:, 0], pixels[:, 1], (6 * pixels[:, 0]).sin() ** 2], dim=-1)
    here = {"ctm": ctm, "colors": dark.repeat(9, 1), "rays": pixels, "rgb": dark}
    exec(f"{first}\n{fitting}", here)
    sizes = {"means": (64, 2), "scales": (64, 1), "opacities": (64, 1), "colors": (64, here["transform"].channels)}
    splats = torch.nn.ParameterDict({name: torch.rand(size) for name, size in sizes.items()})
    rates = {"means": 1e-3, "scales": 5e-3, "opacities": 5e-2, "colors": 2e-2}
    optimizers = {
        name: torch.optim.Adam([{"params": splats[name], "lr": rate, "name": name}], eps=1e-15)
        for name, rate in rates.items()
    }
    schedulers = [torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], gamma=0.01 ** (1 / max_steps))]

    def rasterization(at: torch.Tensor) -> torch.Tensor:
        away = torch.cdist(at, splats["means"]) / (0.1 * splats["scales"].exp().T)
        alphas = splats["opacities"].sigmoid().T * (-0.5 * away**2).exp()
        left = torch.cat([torch.ones(len(at), 1), (1 - alphas).cumprod(dim=1)[:, :-1]], dim=1)
        return (alphas * left) @ splats["colors"].sigmoid()

    here["field"] = rasterization
    errors = []
    for _ in range(max_steps):
        exec(comparing, here)
        here["loss"].backward()
        for optimizer in [*optimizers.values(), here["adam"]]:
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        for scheduler in schedulers:
            scheduler.step()
        with torch.no_grad():
            exec(decoding, here)
            errors.append(float((here["picture"] - dark).square().mean()))
    assert here["picture"].shape == dark.shape
    assert errors[-1] < errors[0] / 10
