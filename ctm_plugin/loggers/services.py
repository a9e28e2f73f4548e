"""Services that keep the curves and pictures of many runs: Weights & Biases, MLflow."""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock
from lightning.pytorch.loggers import MLFlowLogger, WandbLogger
from lightning.pytorch.loggers.logger import rank_zero_experiment
from PIL import Image
from torch import Tensor

from ctm_plugin.data.readers.images import to_8_bits
from ctm_plugin.errors import CheckpointError
from ctm_plugin.loggers.base import BINS, RunLogger
from ctm_plugin.settings.build import setting
from ctm_plugin.settings.check import check_choice


class WandB(RunLogger, WandbLogger):
    """Weights & Biases, in `WANDB_DIR`, else in a folder `wandb` next to the run's (needs the extra `wandb`).

    A resumed run goes on by the id in ``RUN/wandb.txt``. Not inside the run: W&B makes links that lead out of it.
    """

    @dataclass(frozen=True, kw_only=True)
    class Config:
        """Where runs go."""

        project: str = setting("ctm_plugin", "project that runs are put into")
        mode: str = setting("offline", "offline: files for `wandb sync`; online: straight to the service")
        group: str | None = setting(
            None, "name of a group of runs; null: a sweep's folder, and no group for single runs"
        )

        def __post_init__(self) -> None:
            check_choice("logger.mode", self.mode, ("offline", "online"))

    def __init__(self, config: Config, run: Path, step: int):
        self.kept = run / "wandb.txt"
        super().__init__(
            name=run.name,
            save_dir=os.environ.get("WANDB_DIR") or run.parent,
            id=kept_id(self.kept) or secrets.token_hex(4),
            project=config.project,
            mode=config.mode,
            group=config.group or sweep_of(run),
        )

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:
        new, began = self._experiment is None, super().experiment
        if new:
            self.kept.write_text(began.id, encoding="utf-8")
        return began

    def log_pictures(self, pictures: Mapping[str, Tensor], step: int) -> None:
        for name, picture in pictures.items():
            self.log_image(name, [image(picture)], step)

    def log_histograms(self, values: Mapping[str, Tensor], step: int) -> None:
        from wandb import Histogram

        counts = {name: np.histogram(numbers.numpy(), BINS) for name, numbers in values.items()}
        self.log_metrics({name: Histogram(np_histogram=count) for name, count in counts.items()}, step)

    def close(self) -> None:
        if self._experiment is not None:
            self._experiment.finish()  # or the next run of a sweep would go on with it


class MLflow(RunLogger, MLFlowLogger):
    """MLflow, to `MLFLOW_TRACKING_URI`, else a folder `mlflow` in the run's or its sweep's (needs the extra `mlflow`).

    A resumed run goes on by the id in ``RUN/mlflow.txt``.
    """

    @dataclass(frozen=True, kw_only=True)
    class Config:
        """Where runs go."""

        experiment: str = setting("ctm_plugin", "experiment that runs are put into")

    def __init__(self, config: Config, run: Path, step: int):
        self.kept, self.home = run / "mlflow.txt", run.parent if sweep_of(run) else run
        os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")  # or MLflow >= 3.7 refuses a folder
        super().__init__(
            config.experiment,
            run_name=run.name,
            tags={"sweep": sweep_of(run)} if sweep_of(run) else None,
            tracking_uri=os.environ.get("MLFLOW_TRACKING_URI"),
            save_dir=str(self.home / "mlflow"),
            run_id=kept_id(self.kept),
        )

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:
        with FileLock(self.home / ".mlflow.lock"):  # two of a sweep's runs at once would both make the experiment
            client = super().experiment
        if not self.kept.is_file():
            self.kept.write_text(self._run_id, encoding="utf-8")
        return client

    def log_pictures(self, pictures: Mapping[str, Tensor], step: int) -> None:
        for name, picture in pictures.items():
            self.experiment.log_image(self.run_id, image(picture), key=name, step=step)


def sweep_of(run: Path) -> str | None:
    """Name the sweep that a run is of, by its folder; ``None`` for a single run."""
    return run.parent.name if (run.parent / "multirun.yaml").is_file() else None


def kept_id(file: Path) -> str | None:
    """Read what a service calls a run, out of the run's folder; ``None`` for a new run.

    Raises:
        CheckpointError: it is something else.
    """
    found = file.read_text(encoding="utf-8", errors="replace") if file.is_file() else None
    if found is not None and not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", found):
        raise CheckpointError(file, repr(found), "a run's id")
    return found


def image(picture: Tensor) -> Image.Image:
    """Turn ``[H, W, 3]`` in [0, 1] into a picture for services that would guess how an array is scaled."""
    return Image.fromarray(to_8_bits(picture.float()).numpy())
