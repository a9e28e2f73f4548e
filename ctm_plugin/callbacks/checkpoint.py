"""Checkpoints that are whole or not there, and a stop that saves first."""

from __future__ import annotations

import os
import signal
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.errors import CheckpointError, Interrupted, handling
from ctm_plugin.files import check_zip, replacing
from ctm_plugin.settings.build import Config

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals after which a training saves and stops."""


class CheckpointFile(TorchCheckpointIO):
    """A checkpoint written straight into its file; Lightning's own way puts all of it into memory first, twice."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Path, storage_options: Any = None) -> None:
        try:
            with Path(path).open("wb") as file:
                torch.save(checkpoint, file)
        except RuntimeError as error:
            # torch, closing a file that is not whole, puts its own error over a full disk's or a Ctrl-C's.
            raise error.__context__ or error from None


class RunInfo(L.Callback):
    """Put the run's configuration, plain containers, into its checkpoints, so that another run's is recognised."""

    def __init__(self, config: Config):
        self.config = dict(config)

    def on_save_checkpoint(self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]) -> None:
        checkpoint["config"] = self.config


class LastCheckpoint(L.Callback):
    """Keep ``last.ckpt`` current: every so many steps, at the end, and on Ctrl-C or SIGTERM.

    A first signal ends the run after the step in progress and saves; a second one ends it at once. Before the first
    step there is nothing to save and a signal ends the run. Checkpoints are made between optimizer steps only: none
    holds the gradients of a step half accumulated. The file is written next to its place, read back, and renamed; the
    one before it stays, so that a good one is there at any time.

    Args:
        run: the run directory, for the message.
        path, previous: files of the latest checkpoint and of the one before it.
        every: optimizer steps between saves, >= 1.

    Attributes:
        begun: whether training has begun; a checkpoint to resume from is restored by then.
        signalled, signal: whether a signal came to this process, and which.
        stopped: whether a signal came to any process.
    """

    def __init__(self, run: Path, path: Path, previous: Path, every: int):
        self.run, self.path, self.previous, self.every = run, path, previous, every
        self.saved_at, self.signal = -1, int(signal.SIGINT)
        self.begun = self.stopped = self.signalled = self._stepping = False

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Context round a ``fit`` in which Ctrl-C and SIGTERM stop the training after its step."""
        with handling(self._stop, *SIGNALS) as self._before:
            yield

    @contextmanager
    def stopping_at_once(self, when: str) -> Iterator[None]:
        """Context in which SIGTERM raises Interrupted at once, for work that needs no saving, such as scoring."""

        def stop(number: int, frame: Any) -> None:
            raise Interrupted(when, self.run, number)

        with handling(stop, signal.SIGTERM):
            yield

    def _stop(self, number: int, frame: Any) -> None:
        self.signalled, self.signal = True, number
        for each, handler in self._before.items():  # a second one ends it at once
            signal.signal(each, handler)
        if not self._stepping:
            raise Interrupted("before the first step", self.run, number)

    def on_train_start(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        self.begun, self.saved_at = True, trainer.global_step
        if signal.getsignal(signal.SIGINT) == self._stop:
            signal.signal(signal.SIGTERM, self._stop)  # Lightning has put a handler of its own in its place

    def on_train_batch_start(self, *_: Any) -> None:
        self._stepping = True

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: Backbone, *_: Any) -> None:
        if not pl_module.between_steps:
            return
        step = trainer.global_step
        # The signal may have reached one process of several, or reached them in different steps.
        self.stopped = trainer.strategy.reduce_boolean_decision(self.signalled, all=False)
        if self.stopped:
            trainer.should_stop = True
            if pl_module.batches_seen % trainer.val_check_batch:  # else Lightning validates once more
                trainer.limit_val_batches = 0
        if step > self.saved_at and (self.stopped or step % self.every == 0 or step == trainer.max_steps):
            self.save(trainer)

    def on_train_end(self, trainer: L.Trainer, pl_module: Backbone) -> None:
        if trainer.global_step > self.saved_at:  # another callback has ended it
            self.save(trainer)

    def save(self, trainer: L.Trainer) -> None:
        """Write the checkpoint now.

        Raises:
            CheckpointError: it cannot be written; the last good one stays.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(self.path) as beside:
                trainer.save_checkpoint(beside)
                if beside.exists():  # only one of several processes writes
                    check_zip(beside)
                    with suppress(FileNotFoundError):
                        os.replace(self.path, self.previous)
        except (OSError, zipfile.BadZipFile) as error:
            kept = next((str(path) for path in (self.path, self.previous) if path.exists()), "none yet")
            expected = f"room for a checkpoint; last good one kept: {kept}"
            raise CheckpointError(self.path, f"nothing that can be written ({error})", expected) from error
        self.saved_at = trainer.global_step
