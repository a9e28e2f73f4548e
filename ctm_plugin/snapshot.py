"""What a field looks like in the middle of its training, without a trace left in it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch
from lightning.pytorch.utilities.seed import isolate_rng
from torch import Tensor

from ctm_plugin.backbones.barf2d import BARF2D
from ctm_plugin.backbones.base import Backbone
from ctm_plugin.backbones.radiance import RadianceBackbone
from ctm_plugin.cube import cube_picture
from ctm_plugin.data.scene import composite
from ctm_plugin.draws import Draws
from ctm_plugin.metrics.enhance import enhancement_gain, lift, psnr_enhanced
from ctm_plugin.metrics.image import psnr
from ctm_plugin.metrics.precision import full_float32
from ctm_plugin.pictures import beside, depth_picture, error_picture, latent_picture
from ctm_plugin.planar import outlines

WIDTH = 128
"""Largest width of a picture in pixels."""
STEPS = 8
"""Largest number of its pixels, in training steps' rays: between pictures there are hundreds of steps."""
COLORS = 1024
"""How many of the scene's colours are shown."""


@dataclass
class Snapshot:
    """Pictures ``[H, W, 3]``, latents ``[..., k]`` and scores, by TensorBoard's names for them; on the CPU."""

    pictures: dict[str, Tensor] = field(default_factory=dict)
    latents: dict[str, Tensor] = field(default_factory=dict)
    scores: dict[str, float] = field(default_factory=dict)


def snapshot(module: Backbone) -> Snapshot:
    """The colours as the transform sees them and, for radiance fields and planar alignment, one small rendering.

    Weights, modes and random states of the training stay as they are.

    Returns:
        Pictures: ``colors/cube`` (:func:`ctm_plugin.cube.cube_picture`); of the first test view, or of the picture
        under alignment, ``test/render``, ``target``, ``error``, ``latent``, and where it is dark ``lifted``, the
        rendering beside its target; of a view ``depth`` too, of an alignment ``warps``. Latents: ``latent/scene``, of
        the training's colours, and ``latent/render``. Scores: ``psnr/test_view`` and ``psnr/test_view_lifted``.
    """
    with _untouched(module):
        colors = module.scene_colors(Draws(module.seed, 0, module.device), COLORS)
        whole = Snapshot(latents={"latent/scene": module.transform.encode(colors).float().cpu()})
        if isinstance(module, RadianceBackbone):
            _view(module, whole)
        elif isinstance(module, BARF2D):
            _planar(module, whole)
        whole.pictures["colors/cube"] = cube_picture(module.transform, colors)
    return whole


@contextmanager
def _untouched(module: Backbone) -> Iterator[None]:
    modes = [(part, part.training) for part in module.modules()]
    module.eval()
    try:
        with isolate_rng(), torch.no_grad(), full_float32(module.device):
            yield
    finally:
        for part, training in modes:
            part.training = training


def stride(module: Backbone, width: int, height: int) -> int:
    """Of which rows and columns a picture is rendered: of every first, second, third, ..."""
    return math.ceil(max(width / WIDTH, (width * height / (STEPS * module.rays)) ** 0.5))


def _view(module: RadianceBackbone, whole: Snapshot) -> None:
    scene, every = module.scene, stride(module, module.scene.test.width, module.scene.test.height)
    view = {name: value.float().cpu() for name, value in module.render_view(scene.test, 0, every).items()}
    target = composite(scene.test.images[0, ::every, ::every], module.constant_background().cpu())
    _compared(whole, view["rgb"], target, view["latent"], scene.exposure)
    whole.pictures["test/depth"] = depth_picture(view["depth"], scene.near, scene.far)


def _planar(module: BARF2D, whole: Snapshot) -> None:
    scene, every = module.scene, stride(module, module.scene.width, module.scene.height)
    latent = module.render_image(every)
    target = scene.image[::every, ::every]
    gain = _compared(whole, module.decode(latent).cpu(), target, latent.float().cpu(), scene.exposure)
    lit = lift(scene.image, gain)
    whole.pictures["test/warps"] = outlines(lit, module.warps.detach().cpu(), scene.true_warps, scene.patch)[::2, ::2]


def _compared(whole: Snapshot, render: Tensor, target: Tensor, latent: Tensor, exposure: float | None) -> float:
    """What all renderings have; returns by how much the light is turned up."""
    gain = max(enhancement_gain([target], exposure), 1.0)
    whole.latents["latent/render"] = latent
    whole.pictures |= {
        "test/render": render,
        "test/target": target,
        "test/error": error_picture((render - target).abs().mean(-1), float(target.max()) / 4),
        "test/latent": latent_picture(latent),
    }
    whole.scores["psnr/test_view"] = float(psnr(render[None], target[None]))
    if gain > 1:
        whole.pictures["test/lifted"] = beside(lift(render, gain), lift(target, gain))
        whole.scores["psnr/test_view_lifted"] = float(psnr_enhanced(render, target, gain))
    return gain
