"""One progress bar over a whole training, all stages included."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import lightning as L

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.callbacks.deadline import Deadline
from ctm_plugin.metrics.image import psnr
from ctm_plugin.show.bars import Update, bar, error_console


@dataclass(eq=False)
class ProgressLine(L.Callback):
    """Progress bar: steps, loss, PSNR of the batch in RGB, rays a second, ETA; lines where there is no terminal."""

    def __post_init__(self) -> None:
        self.console = error_console()
        self.refresh = 0.5 if self.console.is_terminal else 20.0
        self._stack = ExitStack()
        self._shown: Update | None = None
        self._last = (0.0, 0)

    def on_train_start(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        self._last = (time.perf_counter(), trainer.global_step)
        if trainer.is_global_zero and (fit := pl_module.transform.describe()):
            self.console.print(f"fitted to the scene's colours: {fit}", highlight=False, markup=False)
        if self.console.is_terminal and trainer.is_global_zero:
            shown = bar("training", pl_module.schedule_steps, int(pl_module.scheduled), self.console)
            self._shown = self._stack.enter_context(shown)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: Backbone, outputs: Any, *_: Any) -> None:
        now, step = time.perf_counter(), trainer.global_step
        then, before = self._last
        if not trainer.is_global_zero or (now - then < self.refresh and step < trainer.max_steps):
            return
        rays = trainer.accumulate_grad_batches * pl_module.rays(before, step) / max(now - then, 1e-9)
        loss = float(sum(pl_module.terms.values()))
        score = float(psnr(pl_module.decode(outputs["latent"])[None], outputs["rgb"][None]))
        figures = f"loss {loss:.5f}  PSNR {score:.2f}  {rays:,.0f} rays/s"
        stage = getattr(pl_module, "stage", "training")
        deadline = next((each for each in trainer.callbacks if isinstance(each, Deadline)), None)
        if self._shown is not None:
            self._shown(pl_module.scheduled, figures, None if deadline is None else deadline.left)
        elif step > before:
            left = deadline.left if deadline else (trainer.max_steps - step) * (now - then) / (step - before)
            self.console.print(f"{stage} {step}/{trainer.max_steps}  {figures}  ETA {left:.0f} s", highlight=False)
        self._last = (now, step)

    def teardown(self, *_: Any, **__: Any) -> None:
        self._stack.close()
        self._shown = None

    on_exception = teardown
