"""Checkpoints that are whole or not there, and a stop that saves first."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import lightning as L

from ctm_plugin.files import replacing


class LastCheckpoint(L.Callback):
    """Keep ``last.ckpt`` current: every so many steps, at the end, and on Ctrl-C or SIGTERM.

    A first signal ends the run after the step in progress and saves; a second one ends it at once. The file is written
    beside its place and renamed, so that a good one is there at any time.

    Args:
        path: of the checkpoint.
        every: optimizer steps between saves, >= 1.
    """

    def __init__(self, path: Path, every: int):
        self.path = path
        self.every = every
        self.saved_at = -1
        self.stopped_by: signal.Signals | None = None
        self._previous: dict[signal.Signals, Any] = {}

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.saved_at = trainer.global_step

        def stop(number: int, frame: Any) -> None:
            self.stopped_by = signal.Signals(number)
            trainer.should_stop = True
            self._restore_handlers()

        for number in (signal.SIGINT, signal.SIGTERM):
            try:
                self._previous[number] = signal.signal(number, stop)
            except ValueError:  # not in the main thread, where Python allows no handlers
                return

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        step = trainer.global_step
        if step > self.saved_at and (step % self.every == 0 or step == trainer.max_steps or self.stopped_by):
            self.save(trainer)

    def save(self, trainer: L.Trainer) -> None:
        """Write the checkpoint now."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(self.path) as path:
            trainer.save_checkpoint(path)
        self.saved_at = trainer.global_step

    def teardown(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        self._restore_handlers()

    def _restore_handlers(self) -> None:
        while self._previous:
            number, handler = self._previous.popitem()
            signal.signal(number, handler)
