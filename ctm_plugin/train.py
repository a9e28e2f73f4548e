"""One run: build, fit, render and score, write it all down."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.loggers import TensorBoardLogger
from rich.console import Console

from ctm_plugin.allocator import keep_memory
from ctm_plugin.assemble import Config, Parts, assemble
from ctm_plugin.callbacks.checkpoint import LastCheckpoint
from ctm_plugin.callbacks.dashboard import Dashboard
from ctm_plugin.callbacks.finite import FiniteLoss
from ctm_plugin.callbacks.progress import ProgressLine, error_console
from ctm_plugin.callbacks.runinfo import RunInfo
from ctm_plugin.callbacks.stopwatch import Stopwatch, peak_memory_mb
from ctm_plugin.config import build
from ctm_plugin.console import print_summary
from ctm_plugin.errors import CheckpointError, CTMError
from ctm_plugin.evaluate import run_figures, score
from ctm_plugin.files import write_json
from ctm_plugin.rundir import LAST, METRICS, load_checkpoint, load_config, save_config
from ctm_plugin.trainer_config import TrainerConfig


class Interrupted(CTMError):
    """The run was asked to stop; what it had is saved."""


def train(config: Config, run: Path) -> dict[str, Any]:
    """Train, render and score a new run in the directory ``run``.

    Args:
        config: the resolved configuration, plain containers.
        run: an existing or new directory.

    Returns:
        What ``metrics.json`` holds.

    Raises:
        CTMError: on bad input, before any training, or when training cannot go on.
    """
    if (run / LAST).exists():
        raise CheckpointError(run, "a run that is there already", f"a new directory, or resume={run}")
    parts = assemble(config)
    try:
        run.mkdir(parents=True, exist_ok=True)
        save_config(run, config)
    except OSError as error:
        raise CTMError(f"{run}: cannot be written to ({error.strerror}), expected a writable run directory") from error
    return _fit_and_score(config, run, parts, None)


def resume(run: Path) -> dict[str, Any]:
    """Go on with an interrupted run from its last checkpoint, with its own configuration.

    A run that was interrupted before its first checkpoint starts again.

    Raises:
        CTMError: the directory is no run, or its checkpoint cannot be used.
    """
    config = load_config(run)
    checkpoint = None
    if (run / LAST).exists():
        load_checkpoint(run, config)
        checkpoint = run / LAST
    return _fit_and_score(config, run, assemble(config), checkpoint)


def _fit_and_score(config: Config, run: Path, parts: Parts, checkpoint: Path | None) -> dict[str, Any]:
    keep_memory()
    settings = build(TrainerConfig, config["trainer"], "trainer")
    module = parts.backbone
    stopwatch, last = Stopwatch(), LastCheckpoint(run / LAST, settings.checkpoint_every)
    _quieten()
    trainer = L.Trainer(
        accelerator=settings.accelerator,
        devices=settings.devices,
        strategy=settings.strategy,
        precision=settings.precision,
        accumulate_grad_batches=settings.accumulate_grad_batches,
        gradient_clip_val=settings.gradient_clip_val,
        max_steps=module.total_steps,
        logger=TensorBoardLogger(run, name="", version="tensorboard"),
        callbacks=[
            stopwatch,
            RunInfo(config),
            parts.attach,
            FiniteLoss(run / LAST),
            ProgressLine(error_console()),
            Dashboard(settings.log_every, settings.image_every),
            last,
        ],
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=run,
    )
    trainer.fit(module, ckpt_path=checkpoint, weights_only=True)
    if last.stopped_by is not None and trainer.global_step < module.total_steps:
        raise Interrupted(f"stopped after step {trainer.global_step}; go on with: python -m ctm_plugin resume={run}")
    if not trainer.is_global_zero:
        return {}
    result = score(module, config, run / "test")
    result |= run_figures(module, config, trainer.global_step, stopwatch.seconds, peak_memory_mb())
    write_json(run / METRICS, result)
    print_summary(Console(), result, run)
    return result


def _quieten() -> None:
    """Lightning's advice on data loaders and its list of devices are not for our users."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in (".*does not have many workers.*", ".*does not have a `val_dataloader`.*", ".*`val_dataloader`.*"):
        warnings.filterwarnings("ignore", message, module="lightning.*")
