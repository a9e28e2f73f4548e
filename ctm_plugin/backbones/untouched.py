"""Snapshots of a field while it trains, which do not change the training."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch
from lightning.pytorch.utilities.seed import isolate_rng

from ctm_plugin.draws import Draws
from ctm_plugin.metrics.precision import full_float32
from ctm_plugin.show.color_cube import cube_picture
from ctm_plugin.show.snapshot import Snapshot

if TYPE_CHECKING:
    from ctm_plugin.backbones.base import Backbone

COLORS = 1024
"""How many of the scene's colours are shown."""


def snapshot(module: Backbone, view: int) -> Snapshot:
    """Snapshot of a test view by a backbone, with pictures of the training colours and of their latents.

    Weights, modes and random states of the training stay as they are.

    Returns:
        :meth:`Backbone.snapshot` with the picture ``colors/cube`` (:func:`ctm_plugin.show.color_cube.cube_picture`)
        and, of the training's colours, the latents ``latent/scene``.
    """
    with untouched(module):
        colors = module.scene_colors(Draws(module.seed, 0, module.device, stream="dashboard"), COLORS)
        latents = {"latent/scene": module.transform.encode(colors).float().cpu()}
        shown = module.snapshot(view)
        cube = {"colors/cube": cube_picture(module.transform, colors, module.light)}
        return Snapshot(shown.pictures | cube, latents | shown.latents, shown.scores)


@contextmanager
def untouched(module: Backbone) -> Iterator[None]:
    """Context with a module in evaluation mode; weights, modes and random states of the training stay as they are."""
    modes = [(part, part.training) for part in module.modules()]
    module.eval()
    try:
        with isolate_rng(), torch.no_grad(), full_float32(module.device):
            yield
    finally:
        for part, training in modes:
            part.training = training
