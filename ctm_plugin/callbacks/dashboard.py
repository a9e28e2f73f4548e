"""Curves and pictures of a training for loggers; the training itself does not change."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import lightning as L
import torch

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.backbones.untouched import snapshot
from ctm_plugin.metrics.image import psnr
from ctm_plugin.show.snapshot import Snapshot


@dataclass(eq=False)
class Dashboard(L.Callback):
    """Curves every ``trainer.log_every`` steps; pictures before the first step, of validations, and after the last one.

    Curves: each loss term by name, PSNR in RGB and in the latent space, the learning rates of all optimizers, what a
    step takes, and the backbone's own (``stats``). Pictures, histograms of latents and the PSNR of a test view: see
    :func:`snapshot`.

    All curves up to a checkpoint are on disk when the checkpoint is.
    """

    def __post_init__(self) -> None:
        self._last = (0.0, 0)

    def on_train_start(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        self._last = (time.perf_counter(), trainer.global_step)

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: Backbone, *_: Any) -> None:
        # Not when training starts: fields prepare themselves there, after the callbacks.
        if pl_module.batches_seen == 0:
            self._extra(trainer, pl_module)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: Backbone, outputs: Any, *_: Any) -> None:
        step = trainer.global_step
        if pl_module.between_steps and step % trainer.log_every_n_steps == 0:
            self._curves(trainer, pl_module, outputs, step)
        if step == trainer.max_steps and pl_module.batches_seen % trainer.val_check_batch:
            self._extra(trainer, pl_module)

    def on_validation_batch_end(
        self, trainer: L.Trainer, pl_module: Backbone, outputs: Snapshot, batch: Any, batch_idx: int, *_: Any
    ) -> None:
        if batch_idx == 0 and trainer.state.fn == "fit" and not trainer.sanity_checking:
            self._pictures(trainer, outputs)

    def on_validation_end(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        self._last = (time.perf_counter(), trainer.global_step)

    def on_save_checkpoint(self, trainer: L.Trainer, pl_module: Backbone, checkpoint: dict[str, Any]) -> None:
        for logger in trainer.loggers:
            logger.save()

    def _extra(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        """Log pictures of the first and the last step, which have no validation."""
        if trainer.is_global_zero and trainer.loggers and trainer.enable_validation:
            seen = snapshot(pl_module, pl_module.snapshots[0])
            self._pictures(trainer, seen)
            for logger in trainer.loggers:
                logger.log_metrics({f"val/{name}": value for name, value in seen.scores.items()}, trainer.global_step)
            self.on_validation_end(trainer, pl_module)

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
        # What ``log`` is given Lightning looks at after every batch, and hands on after checkpoints are written.
        trainer.callback_metrics.update({name: torch.tensor(number) for name, number in numbers.items()})
        for logger in trainer.loggers if trainer.is_global_zero else ():
            logger.log_metrics(numbers, step)

    def _pictures(self, trainer: L.Trainer, seen: Snapshot) -> None:
        values = {
            f"{name}_{channel}": numbers
            for name, latents in seen.latents.items()
            for channel, numbers in enumerate(latents.flatten(0, -2).clamp(0, 1).unbind(-1))
            if numbers.isfinite().all()  # else FiniteLoss says so at its next check, and torch's bins do not
        }
        for logger in trainer.loggers if trainer.is_global_zero else ():
            logger.log_pictures(seen.pictures, trainer.global_step)
            logger.log_histograms(values, trainer.global_step)
