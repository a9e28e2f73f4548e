"""Curves and pictures of a training for loggers; the training itself does not change."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import lightning as L
import torch
from lightning.pytorch.utilities.seed import isolate_rng

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.callbacks.settings import DashboardConfig
from ctm_plugin.draws import Draws
from ctm_plugin.metrics.image import psnr
from ctm_plugin.metrics.precision import full_float32
from ctm_plugin.show.color_cube import cube_picture
from ctm_plugin.show.snapshot import Snapshot

CUBE_COLORS = 1024
"""Number of the scene's colours in the picture of the colour cube."""


@dataclass(eq=False)
class Dashboard(DashboardConfig, L.Callback):
    """Curves every ``trainer.log_every`` steps; pictures before the first step, now and then, and after the last one.

    Curves: each loss term by name, PSNR in RGB and in the latent space, the learning rates of all optimizers, what a
    step takes, and the backbone's own (``stats``). Pictures, histograms of latents and the PSNR of a test view: see
    :func:`snapshot`.

    All that was logged up to a checkpoint is on disk when the checkpoint is.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        self._last = (0.0, 0)

    def on_train_start(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        self._last = (time.perf_counter(), trainer.global_step)

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: Backbone, *_: Any) -> None:
        # Not when training starts: fields prepare themselves there, after the callbacks.
        if pl_module.batches_seen == 0 and self._is_watched(trainer) and self.image_every is not None:
            self._pictures(trainer, pl_module, 0)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: Backbone, outputs: Any, *_: Any) -> None:
        if not pl_module.between_steps or not self._is_watched(trainer):
            return
        step = trainer.global_step
        if step % trainer.log_every_n_steps == 0:
            self._curves(trainer, pl_module, outputs, step)
        if self.image_every is not None and (step % self.image_every == 0 or step == trainer.max_steps):
            self._pictures(trainer, pl_module, step)

    def on_save_checkpoint(self, trainer: L.Trainer, pl_module: Backbone, checkpoint: dict[str, Any]) -> None:
        for logger in trainer.loggers:
            logger.save()

    def _is_watched(self, trainer: L.Trainer) -> bool:
        return trainer.is_global_zero and bool(trainer.loggers)

    def _curves(self, trainer: L.Trainer, pl_module: Backbone, outputs: Any, step: int) -> None:
        now = time.perf_counter()
        then, before = self._last
        self._last = (now, step)
        values = {f"loss/{name}": value for name, value in pl_module.terms.items()}
        values["loss/total"] = sum(pl_module.terms.values())  # outputs["loss"] is divided by the accumulated batches
        values["psnr/rgb"] = psnr(pl_module.decode(outputs["latent"])[None], outputs["rgb"][None])
        values["psnr/latent"] = psnr(outputs["latent"].float()[None], outputs["target"][None])
        for group in pl_module.named_optimizers.param_groups:
            values[f"lr/{group['name']}"] = group["lr"]
        each = (now - then) / (step - before)
        values["speed/ms_per_step"] = 1000 * each
        values["speed/rays_per_second"] = trainer.accumulate_grad_batches * pl_module.rays(before, step) / (now - then)
        values |= {f"field/{name}": value for name, value in pl_module.stats().items()}
        numbers = {name: float(value) for name, value in values.items()}
        for logger in trainer.loggers:
            logger.log_metrics(numbers, step)

    def _pictures(self, trainer: L.Trainer, pl_module: Backbone, step: int) -> None:
        seen = snapshot(pl_module)
        values = {
            f"{name}_{channel}": numbers
            for name, latents in seen.latents.items()
            for channel, numbers in enumerate(latents.flatten(0, -2).clamp(0, 1).unbind(-1))
            if numbers.isfinite().all()  # else FiniteLoss says so at its next check, and torch's bins do not
        }
        for logger in trainer.loggers:
            logger.log_pictures(seen.pictures, step)
            logger.log_histograms(values, step)
            if seen.scores:
                logger.log_metrics(seen.scores, step)
        self._last = (time.perf_counter(), step)


def snapshot(module: Backbone) -> Snapshot:
    """What a backbone shows of itself, and the colours as its transform sees them.

    Weights, modes and random states of the training stay as they are.

    Returns:
        :meth:`Backbone.snapshot` with the picture ``colors/cube`` (:func:`ctm_plugin.show.color_cube.cube_picture`)
        and, of the training's colours, the latents ``latent/scene``.
    """
    with untouched(module):
        colors = module.scene_colors(Draws(module.seed, 0, module.device, stream="dashboard"), CUBE_COLORS)
        latents = {"latent/scene": module.transform.encode(colors).float().cpu()}
        shown = module.snapshot()
        cube = {"colors/cube": cube_picture(module.transform, colors, module.light)}
        return Snapshot(shown.pictures | cube, latents | shown.latents, shown.scores)


@contextmanager
def untouched(module: Backbone) -> Iterator[None]:
    """Within it a module is in evaluation mode; weights, modes and random states of the training stay as they are."""
    modes = [(part, part.training) for part in module.modules()]
    module.eval()
    try:
        with isolate_rng(), torch.no_grad(), full_float32(module.device):
            yield
    finally:
        for part, training in modes:
            part.training = training
