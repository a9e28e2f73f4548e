"""Training of a run, new or resumed: build, fit, render, score, and write its files."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.callbacks.checkpoint import CheckpointFile, LastCheckpoint, RunInfo
from ctm_plugin.callbacks.deadline import Deadline
from ctm_plugin.callbacks.finite import FiniteLoss
from ctm_plugin.callbacks.preview import Preview
from ctm_plugin.callbacks.stopwatch import Stopwatch
from ctm_plugin.color.settings import LossWeights
from ctm_plugin.cpu.allocator import keep_memory
from ctm_plugin.cpu.products import fast_products
from ctm_plugin.cpu.threads import operators_on_one_thread, warn_of_neighbours
from ctm_plugin.data.capture import Capture
from ctm_plugin.errors import CheckpointError, CTMError, Interrupted
from ctm_plugin.files import is_main_process, naming
from ctm_plugin.runs.assemble import Parts, assemble
from ctm_plugin.runs.cameras import note_cameras
from ctm_plugin.runs.data import DATA_FILE, check_data, located, note_data
from ctm_plugin.runs.evaluate import lpips_for, score
from ctm_plugin.runs.load import go_back, load_checkpoint, restore
from ctm_plugin.runs.processes import processes
from ctm_plugin.runs.provenance import code_version
from ctm_plugin.runs.rundir import (
    CONFIG,
    LAST,
    METRICS,
    PREVIOUS,
    load_config,
    locked,
    nodes,
    save_config,
    there_already,
)
from ctm_plugin.runs.settings import RunConfig
from ctm_plugin.settings.build import Config
from ctm_plugin.show.console import print_summary, quieten

Tell = Callable[[dict[str, Any], Path], None]
"""Function that prints a run's scores, given the content of ``metrics.json`` and the run's directory."""
MAX_EXPOSURE_RATIO = 1.2
"""Largest ratio of two pictures' light that counts as one exposure: a quarter of a stop."""
MIN_TRAINING = 20_000 * 5e-4
"""Steps times learning rate below which a transform without pre-training is not near the identity in time (paper:
50)."""
SCORED_SECTIONS = ("dataset", "backbone", "ctm", "color_space", "appearance", "loss")
"""Sections of the configuration that scores depend on."""
NOTED_KEYS = {f"{group}{key}" for group in SCORED_SECTIONS for key in ("", ".name", ".preset")}
"""Keys of the scored sections that a run's hyperparameters have under shorter names."""
NOTED_KEYS |= {"dataset.exposure", "dataset.root", "dataset.image", "loss.kind"}
"""Further keys with a shorter name, or that follow from the data set's name."""


def train(config: Config, run: Path, tell: Tell = print_summary, capture: Capture | None = None) -> dict[str, Any]:
    """Train, render and score a new run in the directory ``run``.

    Args:
        config: the resolved configuration, plain containers.
        run: a new directory, or one that holds no run.
        tell: prints what was found.
        capture: the capture of the run's data, where it has been read already.

    Returns:
        What ``metrics.json`` holds.

    Raises:
        CTMError: on bad input, before any training, or when training cannot go on.
    """
    if is_main_process() and any((run / name).exists() for name in (CONFIG, LAST, METRICS)):
        raise there_already(run)
    parts = assemble(config, run, capture=capture)
    warn_of_short_run(config, parts)
    warn_of_exposures(config, parts)
    # What ``auto`` means here stays with the run, whatever machine goes on with it.
    config = {**config, "trainer": {**config["trainer"], "precision": parts.trainer.numbers}}
    return _fit_and_score(config, run, parts, None, tell, new=True)


def resume(run: Path, tell: Tell = print_summary, root: str | None = None) -> dict[str, Any]:
    """Go on with an interrupted run from its last checkpoint, with its own configuration.

    A run that was interrupted before its first checkpoint starts again; a finished one is scored again. Where a process
    died between putting the last checkpoint aside and the new one in its place, the one before is taken.

    Args:
        run: its directory.
        tell: prints what was found.
        root: the folder of its data from now on, where the old one is not found or its content has changed.

    Raises:
        CTMError: the directory is no run, its data are missing or changed, or its checkpoint cannot be used.
    """
    config = load_config(run)
    name = next((name for name in (LAST, PREVIOUS) if (run / name).exists()), None)
    checkpoint = None if name is None else load_checkpoint(run, config, name)
    there = located(config, run, root)
    parts = assemble(there, run, 0 if checkpoint is None else checkpoint["global_step"])
    check_data(run, parts.scene, refuse=root is None)
    if checkpoint is not None:
        restore(parts, checkpoint, run / name)
        if is_main_process() and checkpoint["global_step"] >= (steps := parts.backbone.total_steps):
            print(f"{run}: finished, all {steps} steps are done; it is scored again", file=sys.stderr)
    if is_main_process() and (root is not None or not (run / DATA_FILE).exists()):
        note_data(run, there, parts.scene)
    del checkpoint  # Lightning reads its own; a large grid's would be held all through the training
    return _fit_and_score(config, run, parts, None if name is None else run / name, tell, new=False)


def command(run: Path, settings: RunConfig) -> None:
    """Go on with an interrupted run, with its own settings, as resume=RUN_DIR does.

    RUN_DIR/checkpoints/previous.ckpt goes on from the checkpoint before the last one.
    """
    resume(go_back(run) if run.suffix == ".ckpt" else run, root=settings.dataset.root)


def warn_of_short_run(config: Config, parts: Parts) -> None:
    """Warn where a training is too short for a learned transform without pre-training."""
    steps, training = parts.backbone.total_steps, parts.backbone.transform.learning
    unready = config["ctm"].get("init") == "random" and not training.pretrain_steps
    if unready and steps * training.lr < MIN_TRAINING:
        warnings.warn(
            f"a transform without pre-training will hold back a run of {steps} steps (the paper's have 20,000 to "
            "100,000): ctm=quick is made for short ones",
            stacklevel=3,
        )


def warn_of_exposures(config: Config, parts: Parts) -> None:
    """Warn where the pictures' exposures differ by EXIF, and no ``appearance`` accounts for it."""
    exposures = parts.scene.train.exposures if parts.backbone.posed else None
    if exposures is None or config["appearance"]["name"] != "none":
        return
    known = exposures[~exposures.isnan()]
    if (ratio := float(known.max() / known.min())) > MAX_EXPOSURE_RATIO:
        warnings.warn(
            f"by their EXIF some pictures took {ratio:.3g} times the light of others: appearance=exposure "
            "appearance.start=exif holds that apart from the scene",
            stacklevel=3,
        )


def hyperparameters(config: Config, module: Backbone, result: Mapping[str, Any]) -> dict[str, Any]:
    """Collect a run's main hyperparameters by short names, then all settings that its scores depend on.

    Without CTM, its weights and frequencies are given as 0, so that such runs have a place on every axis.
    """
    exposure = getattr(getattr(module, "scene", None), "exposure", None)
    values = {name: result[name] for name in ("dataset", "backbone", "ctm", "color_space", "appearance", "steps")}
    values |= {"seed": config["seed"], "loss": module.photometric.kind, "ctm.k": module.channels}
    values["exposure"] = config["dataset"].get("exposure", 1.0) if exposure is None else exposure
    values |= {"ctm.P": 0, "ctm.lr": 0.0, **{f"ctm.weights.{term}": 0.0 for term in vars(LossWeights())}}
    for value, key in (node for group in SCORED_SECTIONS for node in nodes(config[group], group)):
        if key not in NOTED_KEYS and not key.rpartition(".")[2].isdigit():  # no part of a list
            values[key] = value
    return {
        key: str(value).lower() if isinstance(value, bool) else value
        for key, value in values.items()
        if isinstance(value, bool | int | float | str)
    }


def _fit_and_score(
    config: Config, run: Path, parts: Parts, checkpoint: Path | None, tell: Tell, new: bool
) -> dict[str, Any]:
    keep_memory()
    warn_of_neighbours()
    code_version()  # of the code that trains: it is kept, and the checkout may change meanwhile
    module, main = parts.backbone, is_main_process()
    lpips = lpips_for(parts) if main else None
    stopwatch, last = Stopwatch(), LastCheckpoint(run, run / LAST, run / PREVIOUS, parts.trainer.checkpoint_every)
    trainer = _trainer(config, run, parts, [stopwatch, last])
    if main and new:
        save_config(run, config)
        note_data(run, config, parts.scene)
    with ExitStack() as stack:
        stack.enter_context(naming(run))
        if main:
            stack.enter_context(locked(run))
            for left in (run / LAST).parent.glob(f".{(run / LAST).name}.*"):  # of a process that was killed
                left.unlink(missing_ok=True)
            if module.posed:
                note_cameras(run, module)
            for logger in parts.loggers:
                try:
                    logger.open()
                except Exception as error:  # of services, anything
                    text = f"logger={config['logger']['name']}: {error}"
                    raise error if isinstance(error, CTMError) else CTMError(text) from error
                stack.callback(logger.close)
        try:
            products, threads = fast_products(trainer.strategy.root_device), operators_on_one_thread(module.loops_only)
            with last.listening(), processes(run, parts.trainer.devices), products, threads:
                trainer.fit(module, ckpt_path=checkpoint, weights_only=True)
        except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            of_the_machine = isinstance(error, torch.OutOfMemoryError | torch.distributed.DistError)
            if checkpoint is None or last.begun or of_the_machine:
                raise
            found = f"a state that cannot be restored ({type(error).__name__}: {error})"
            raise CheckpointError(checkpoint, found, "that of this version's run") from error
        if last.stopped or last.signalled:
            raise Interrupted(f"after step {trainer.global_step}", run, last.signal)
        if lpips is None:
            return {}
        module.to(trainer.strategy.root_device)  # the Trainer has put it on the CPU
        try:
            with last.stopping_at_once("while scoring"):
                result = score(module, config, run, lpips, trainer.global_step, stopwatch.state_dict())
        except KeyboardInterrupt:
            raise Interrupted("while scoring", run) from None
        for logger in parts.loggers:
            logger.log_scores(hyperparameters(config, module, result), result)
    tell(result, run)
    return result


def _trainer(config: Config, run: Path, parts: Parts, callbacks: list[L.Callback]) -> L.Trainer:
    quieten()
    settings, (stopwatch, last) = parts.trainer, callbacks
    watched = bool(parts.loggers) or any(hasattr(each, "monitor") for each in parts.callbacks)

    try:
        return L.Trainer(
            accelerator=settings.backend,
            devices=settings.devices,
            strategy=settings.strategy,
            use_distributed_sampler=False,
            precision=settings.numbers,
            accumulate_grad_batches=settings.accumulate_grad_batches,
            gradient_clip_val=settings.gradient_clip_val,
            max_steps=parts.backbone.total_steps,
            logger=parts.loggers,
            log_every_n_steps=settings.log_every,
            val_check_interval=(settings.image_every or 1) * settings.accumulate_grad_batches,
            check_val_every_n_epoch=None,
            limit_val_batches=int(settings.image_every is not None and watched),  # one test view
            num_sanity_val_steps=0,
            callbacks=[
                stopwatch,
                *([] if settings.minutes is None else [Deadline(60 * settings.minutes, stopwatch), Preview()]),
                RunInfo(config),
                FiniteLoss(run / LAST),
                *parts.callbacks,
                last,
            ],
            plugins=[CheckpointFile()],
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            default_root_dir=run,
        )
    except MisconfigurationException as error:  # such as a GPU that is not there
        raise CTMError(f"trainer: {error}") from error
