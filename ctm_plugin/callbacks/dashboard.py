"""What TensorBoard shows of a training, which goes on as if nobody had looked."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.pytorch.utilities.seed import isolate_rng

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.board import layout
from ctm_plugin.cube import cube_picture
from ctm_plugin.draws import Draws
from ctm_plugin.metrics.image import psnr
from ctm_plugin.metrics.precision import full_float32
from ctm_plugin.snapshot import Snapshot

BINS = np.linspace(0, 1, 65)
"""Edges of the histograms of latents."""
COLORS = 1024
"""How many of the scene's colours are shown."""


class Dashboard(L.Callback):
    """Curves every ``log_every`` steps; pictures before the first step, every ``image_every`` steps and after the last.

    Curves: each loss term by name, PSNR in RGB and in the latent space, the learning rates of all optimizers, what a
    step takes, and the backbone's own (``stats``). Pictures, histograms of latents and the PSNR of a test view: see
    :func:`snapshot`; ``image_every=None`` leaves them out.

    All that was logged up to a checkpoint is on disk when the checkpoint is.
    """

    def __init__(self, log_every: int, image_every: int | None):
        self.log_every = log_every
        self.image_every = image_every
        self._last = (0.0, 0)

    def on_train_start(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        self._last = (time.perf_counter(), trainer.global_step)

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: Backbone, *_: Any) -> None:
        # Not when training starts: fields prepare themselves there, after the callbacks.
        if trainer.is_global_zero and pl_module.batches_seen == 0:
            trainer.logger.experiment.add_custom_scalars(layout())
            if self.image_every is not None:
                self._pictures(trainer, pl_module, 0)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: Backbone, outputs: Any, *_: Any) -> None:
        if not trainer.is_global_zero or pl_module.batches_seen % trainer.accumulate_grad_batches:
            return
        step = trainer.global_step
        if step % self.log_every == 0:
            self._curves(trainer, pl_module, outputs, step)
        if self.image_every is not None and (step % self.image_every == 0 or step == trainer.max_steps):
            self._pictures(trainer, pl_module, step)

    def on_save_checkpoint(self, trainer: L.Trainer, pl_module: Backbone, checkpoint: dict[str, Any]) -> None:
        if trainer.is_global_zero:
            trainer.logger.experiment.flush()

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
        values["speed/rays_per_second"] = trainer.accumulate_grad_batches * pl_module.rays / each
        values |= {f"field/{name}": value for name, value in pl_module.stats().items()}
        trainer.logger.log_metrics({name: float(value) for name, value in values.items()}, step)

    def _pictures(self, trainer: L.Trainer, pl_module: Backbone, step: int) -> None:
        writer, seen = trainer.logger.experiment, snapshot(pl_module)
        for name, picture in seen.pictures.items():
            writer.add_image(name, picture, step, dataformats="HWC")
        for name, latents in seen.latents.items():
            for channel, values in enumerate(latents.flatten(0, -2).clamp(0, 1).unbind(-1)):
                if values.isfinite().all():  # else FiniteLoss says so at its next check, and torch's bins do not
                    writer.add_histogram(f"{name}_{channel}", values, step, BINS)
        for name, score in seen.scores.items():
            writer.add_scalar(name, score, step)
        self._last = (time.perf_counter(), step)


def snapshot(module: Backbone) -> Snapshot:
    """What a backbone shows of itself, and the colours as its transform sees them.

    Weights, modes and random states of the training stay as they are.

    Returns:
        :meth:`Backbone.snapshot` with the picture ``colors/cube`` (:func:`ctm_plugin.cube.cube_picture`) and, of the
        training's colours, the latents ``latent/scene``.
    """
    with _untouched(module):
        colors = module.scene_colors(Draws(module.seed, 0, module.device), COLORS)
        latents = {"latent/scene": module.transform.encode(colors).float().cpu()}
        shown = module.snapshot()
        cube = {"colors/cube": cube_picture(module.transform, colors)}
        return Snapshot(shown.pictures | cube, latents | shown.latents, shown.scores)


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
