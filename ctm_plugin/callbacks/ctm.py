"""The colour transform as a Lightning callback, with its own optimizer."""

from __future__ import annotations

import math
from dataclasses import dataclass

import lightning as L
import torch
from torch.optim import Adam, Optimizer

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.draws import Draws
from ctm_plugin.errors import ConfigError
from ctm_plugin.optim import Schedule, exponential


@dataclass(frozen=True, kw_only=True)
class TransformTraining:
    """How a learned transform is trained. The defaults are the paper's for NeRF and DVGO.

    Attributes:
        lr, betas: of its own Adam.
        lr_decay: factor that its learning rate reaches, exponentially, at the last joint step.
        pretrain_steps: steps on the cycle terms alone before the joint optimisation, the same Adam carried on.
        pretrain_lr: its learning rate at the start, which falls exponentially to ``lr``; ``None``: ``lr`` throughout.
        pretrain_colors: training colours a pre-training step, and as many random colours and latents.
        freeze: keep the transform fixed in the joint optimisation (a control).
    """

    lr: float = 5e-4
    betas: tuple[float, float] = (0.9, 0.999)
    lr_decay: float = 1.0
    pretrain_steps: int = 0
    pretrain_lr: float | None = None
    pretrain_colors: int = 1024
    freeze: bool = False

    def __post_init__(self) -> None:
        for name, ok, expected in [
            ("lr", 0 < self.lr < math.inf, "a number > 0"),
            ("betas", len(self.betas) == 2 and all(0 <= b < 1 for b in self.betas), "two numbers in [0, 1)"),
            ("lr_decay", 0 < self.lr_decay <= 1, "a number in (0, 1]"),
            ("pretrain_steps", self.pretrain_steps >= 0, "an integer >= 0"),
            ("pretrain_lr", self.pretrain_lr is None or 0 < self.pretrain_lr < math.inf, "a number > 0"),
            ("pretrain_colors", self.pretrain_colors >= 1, "an integer >= 1"),
        ]:
            if not ok:
                raise ConfigError(f"ctm.{name}", getattr(self, name), expected)


class AttachTransform(L.Callback):
    """Put a transform into a :class:`Backbone`, as part of its module tree, before weights are restored.

    Its parameters are then restored, moved and synchronised like any other; its optimizer is its own: an Adam named
    ``ctm`` among the module's optimizers, stepped once a batch.

    Args:
        transform: of as many channels as the backbone renders.
        training: how it is trained; not used for transforms without parameters.
    """

    def __init__(self, transform: ColorTransform, training: TransformTraining | None = None):
        self.transform = transform
        self.training = training or TransformTraining()

    def setup(self, trainer: L.Trainer, pl_module: Backbone, stage: str) -> None:
        self.attach(pl_module)

    def attach(self, pl_module: Backbone) -> None:
        """Put the transform in, and its optimizer among the module's.

        Raises:
            ConfigError: the backbone renders another number of channels.
        """
        if self.transform.channels != pl_module.channels:
            raise ConfigError("ctm.k", self.transform.channels, f"{pl_module.channels}, the backbone's channels")
        pl_module.transform = self.transform
        if any(True for _ in self.transform.parameters()):
            pl_module.transform_optimizer = lambda transform: self._optimizer(transform, pl_module.total_steps)

    def _optimizer(self, transform: ColorTransform, steps: int) -> tuple[Optimizer, Schedule]:
        adam = Adam(transform.parameters(), self.training.lr, self.training.betas, fused=True)
        return adam, exponential(self.training.lr_decay, steps)

    def on_train_start(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        # After the optimizers are restored, so that a resumed run knows that its transform is past pre-training.
        if pl_module.batches_seen == 0:
            with torch.no_grad():
                self.transform.begin(pl_module.scene_colors(self._draws(pl_module, 0), 1 << 15))
            if pl_module.transform_optimizer is not None:
                self.pretrain(pl_module)
        if self.training.freeze:
            self.transform.requires_grad_(False)

    def pretrain(self, pl_module: Backbone) -> None:
        """Minimise the cycle terms on training colours; the same on every process.

        Raises:
            ConfigError: all cycle terms weigh nothing.
        """
        optimizer = pl_module.named_optimizers.members["ctm"]
        (group,) = optimizer.param_groups
        final, steps = group["lr"], self.training.pretrain_steps
        first = self.training.pretrain_lr or final
        for step in range(steps):
            group["lr"] = first * (final / first) ** (step / steps)
            draws = self._draws(pl_module, 1 + step)
            with torch.no_grad():
                rgb = pl_module.scene_colors(draws, self.training.pretrain_colors)
            loss = self.transform.cycle_loss(rgb, draws.uniform)
            if not loss.requires_grad:
                raise ConfigError(
                    "ctm.pretrain_steps", steps, "0 where the cycle terms img, rand and latent weigh nothing"
                )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        group["lr"] = final
        optimizer.zero_grad()

    @staticmethod
    def _draws(pl_module: Backbone, step: int) -> Draws:
        """Of what comes before the joint optimisation, the same on every process; that one draws from step 0 on."""
        return Draws(pl_module.seed, -1 - step, pl_module.device)
