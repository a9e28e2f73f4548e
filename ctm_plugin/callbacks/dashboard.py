"""What TensorBoard shows of a training."""

from __future__ import annotations

import time
from typing import Any

import lightning as L
import torch
from torch.utils.tensorboard import SummaryWriter

from ctm_plugin.backbones.barf2d import BARF2D
from ctm_plugin.backbones.base import Backbone
from ctm_plugin.backbones.radiance import RadianceBackbone
from ctm_plugin.data.scene import composite
from ctm_plugin.metrics.enhance import enhancement_gain, lift
from ctm_plugin.metrics.image import psnr
from ctm_plugin.pictures import depth_picture, error_picture, latent_picture
from ctm_plugin.planar import planar_pictures


class Dashboard(L.Callback):
    """Curves every ``log_every`` steps and pictures of one test view every ``image_every``.

    Curves: each loss term by name, PSNR in RGB and in the latent space, the learning rates of all optimizers, rays per
    second, and the backbone's own (``stats``). Pictures: render, lifted render of dark scenes, latent, depth, error; of
    planar alignment those of :func:`ctm_plugin.planar.planar_pictures`.
    """

    def __init__(self, log_every: int, image_every: int):
        self.log_every = log_every
        self.image_every = image_every
        self._last = (0.0, 0)

    def on_train_start(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        self._last = (time.perf_counter(), trainer.global_step)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: Backbone, outputs: Any, *_: Any) -> None:
        step = trainer.global_step
        if not trainer.is_global_zero or step == self._last[1]:
            return
        if step % self.log_every == 0:
            self._curves(trainer, pl_module, outputs, step)
        if step % self.image_every == 0:
            writer = trainer.logger.experiment
            if isinstance(pl_module, RadianceBackbone):
                self._view(writer, pl_module, step)
            elif isinstance(pl_module, BARF2D):
                for name, picture in planar_pictures(pl_module).items():
                    writer.add_image(f"test/{name}", picture, step, dataformats="HWC")
            self._last = (time.perf_counter(), step)

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
        rays = (step - before) * trainer.accumulate_grad_batches * pl_module.rays
        values["speed/rays_per_second"] = rays / (now - then)
        values |= {f"field/{name}": value for name, value in pl_module.stats().items()}
        trainer.logger.log_metrics({name: float(value) for name, value in values.items()}, step)

    @torch.no_grad()
    def _view(self, writer: SummaryWriter, pl_module: RadianceBackbone, step: int) -> None:
        scene = pl_module.scene
        view = {name: value.float().cpu() for name, value in pl_module.render_view(scene.test, 0).items()}
        target = composite(scene.test.images[0], pl_module.constant_background().cpu())
        gain = enhancement_gain([target], scene.exposure)
        error = (view["rgb"] - target).abs().mean(-1)
        pictures = {
            "render": view["rgb"],
            "target": target,
            "latent": latent_picture(view["latent"]),
            "depth": depth_picture(view["depth"], scene.near, scene.far),
            "error": error_picture(error, float(target.max()) / 4),
        }
        if gain > 1:
            pictures["render_lifted"] = lift(view["rgb"], gain)
        for name, picture in pictures.items():
            writer.add_image(f"test/{name}", picture, step, dataformats="HWC")
        writer.add_scalar("psnr/test_view", float(psnr(view["rgb"][None], target[None])), step)
