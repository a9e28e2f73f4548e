"""The colour transform as a Lightning callback, with its own optimizer."""

from __future__ import annotations

from collections.abc import Callable

import lightning as L
import torch
from torch import Tensor
from torch.optim import Adam, Optimizer

from ctm_plugin.backbones.base import SAMPLE_COLORS, Backbone
from ctm_plugin.color.settings import TransformTraining
from ctm_plugin.color.transform import ColorTransform, fitted
from ctm_plugin.draws import Draws, seeded
from ctm_plugin.errors import ConfigError
from ctm_plugin.optim.schedules import Schedule, exponential

PRETRAIN_COLORS = 1024
"""Training colours in a step of pre-training; random colours and random latents are as many."""


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
        if adam_of(self.transform, self.training):
            pl_module.transform_optimizer = lambda transform: self._optimizer(transform, pl_module.schedule_steps)

    def _optimizer(self, transform: ColorTransform, steps: int) -> tuple[Optimizer, Schedule]:
        return adam_of(transform, self.training), exponential(self.training.lr_decay, steps)

    def on_train_start(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        # After the optimizers are restored, so that a resumed run knows that its transform is past pre-training.
        if pl_module.batches_seen == 0:
            adam = pl_module.named_optimizers.members.get("ctm")
            prepare(self.transform, self.training, adam, pl_module.scene_colors, pl_module.seed, pl_module.device)


def adam_of(transform: ColorTransform, training: TransformTraining) -> Adam | None:
    """Make a transform's own optimizer; ``None`` where it has no parameters."""
    parameters = list(transform.parameters())
    return Adam(parameters, training.lr, training.betas, fused=True) if parameters else None


def prepare(
    transform: ColorTransform, training: TransformTraining, optimizer: Optimizer | None,
    colors: Callable[[Draws, int], Tensor], seed: int, device: torch.device | str = "cpu",
) -> None:  # fmt: skip
    """Do what comes before a transform and a field are trained together: fit it to the scene, then pre-train it.

    The latter minimises the cycle terms on training colours. All of it is the same on every process.

    Args:
        transform, training: what is to be trained, and how.
        optimizer: the transform's own, of one parameter group; ``None`` where it has no parameters.
        colors: ``colors(draws, count)``, ``[count, 3]``: random training colours as evaluation shows them.
        seed, device: of the random numbers.

    Raises:
        ConfigError: all cycle terms weigh nothing.
        CTMError: see :func:`ctm_plugin.color.transform.fitted`.
    """
    with seeded(seed):
        fitted(transform, colors(Draws(seed, 0, device, stream="colors"), SAMPLE_COLORS))
    if optimizer is None:
        return
    (group,) = optimizer.param_groups
    final, steps = group["lr"], training.pretrain_steps
    first = training.pretrain_lr or final
    falling = exponential(final / first, steps)
    for step in range(steps):
        group["lr"] = first * falling(step)
        draws = Draws(seed, step, device, stream="pretraining")
        with torch.no_grad():
            rgb = colors(draws, PRETRAIN_COLORS)
        loss = transform.cycle_loss(rgb, draws.uniform)
        if not loss.requires_grad:
            raise ConfigError("ctm.pretrain_steps", steps, "0 where the cycle terms img, rand and latent weigh nothing")
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    group["lr"] = final
    optimizer.zero_grad()
