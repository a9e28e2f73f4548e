"""A colour transform for a LightningModule of any program."""

from __future__ import annotations

from typing import Any

import lightning as L
from jaxtyping import Float
from torch import Tensor
from torch.optim import Optimizer

from ctm_plugin.color.prepare import adam_of, prepare
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.errors import CTMError
from ctm_plugin.optim.named_optimizers import NamedOptimizers, leave_out
from ctm_plugin.optim.schedules import exponential


class AttachTransform(L.Callback):
    """Attach a colour transform to a LightningModule, fitted before the first step and trained by an Adam of its own.

    As ``self.transform`` it gives the module loss terms (:func:`ctm_plugin.front.losses`) and decodes renderings. The
    module's ``configure_optimizers`` stays; both optimizers are stepped as one, so that accumulation, clipping,
    precision and checkpoints are the Trainer's. This package's backbones get their transform when they are made.

    Args:
        transform: see :func:`ctm_plugin.front.transform`.
        colors: sRGB in [0, 1], of training pixels, some ten thousand.
        seed: seed of the random colours drawn from ``colors``.
    """

    def __init__(self, transform: ColorTransform, colors: Float[Tensor, "n 3"], seed: int = 0):
        self.transform, self.colors, self.seed = transform, colors, seed

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        # In the module tree before weights are restored and before processes are joined.
        pl_module.transform = self.transform
        if stage == "fit" and (adam := adam_of(self.transform)):
            own = pl_module.configure_optimizers
            pl_module.configure_optimizers = lambda: self._both(trainer, own(), adam)

    def _both(self, trainer: L.Trainer, own: Any, adam: Optimizer) -> NamedOptimizers:
        if not isinstance(own, Optimizer):
            raise CTMError(f"configure_optimizers: found {type(own).__name__}, expected one optimizer, no scheduler")
        leave_out(own, set(self.transform.parameters()))
        falling = exponential(self.transform.learning.lr_decay, trainer.estimated_stepping_batches)
        return NamedOptimizers({"field": own, "ctm": adam}, {"ctm": falling})

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if trainer.global_step == 0:  # else a checkpoint has what was found
            colors, adam = self.colors.to(pl_module.device), getattr(trainer.optimizers[0], "members", {}).get("ctm")
            prepare(
                self.transform, adam, lambda draws, count: colors[draws.integers(len(colors), count)], self.seed,
                colors.device,
            )  # fmt: skip

    def on_train_batch_start(self, trainer: L.Trainer, *_: Any) -> None:
        if isinstance(both := trainer.optimizers[0], NamedOptimizers):
            both.set_rates(trainer.global_step)

    def teardown(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        vars(pl_module).pop("configure_optimizers", None)
