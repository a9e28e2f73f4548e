"""Lightning's loggers of TensorBoard and Weights & Biases, made to resume in a run's folder."""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch.loggers import TensorBoardLogger, WandbLogger
from PIL import Image
from torch import Tensor

from ctm_plugin.data.readers.images import to_8_bits
from ctm_plugin.errors import CheckpointError
from ctm_plugin.loggers.base import RunLogger, final
from ctm_plugin.loggers.settings import WandBConfig
from ctm_plugin.metrics.table import METRICS

BINS = np.linspace(0, 1, 65)
"""Edges of the histograms' 64 bins in [0, 1]."""
CHARTS = {
    "Losses": {
        "on colours: color without CTM, enc and dec with it": r"loss/(color|enc|dec)$",
        "CTM's cycles": r"loss/(img|rand|latent)$",
        "the backbone's own": r"loss/(?!(color|enc|dec|img|rand|latent|total)$)",
        "total": r"loss/total$",
    },
    "Learning rates": {"of the field and of CTM": r"lr/"},
    "Speed": {"milliseconds a step": r"speed/ms_per_step$", "rays a second": r"speed/rays_per_second$"},
    "Field": {"the backbone's own numbers": r"field/"},
}
"""Charts that TensorBoard gets besides those of metrics, as regular expressions over tags."""
TRAIN_CHARTS = {"": r"psnr/rgb$", " in the latent space": r"psnr/latent$"}
"""Charts of the training's PSNR, as regular expressions over tags, by suffix of their title."""


class TensorBoard(RunLogger, TensorBoardLogger):
    """Curves, pictures, histograms and a table of runs, for TensorBoard, in the run's folder `tensorboard`.

    ``tensorboard --logdir runs`` shows them, of one run, a sweep, or a folder of both.

    - Custom scalars: quality, losses, learning rates and speed, a chart each. Tags are the same in all colours.
    - Images: the first test view rendered, photographed, their difference, depth and latent; of dark scenes also lit.
      ``colors/cube`` is the RGB cube before and after encoding.
    - Histograms: latents of the scene's colours, and of the test view.
    - HParams: a row a run, with its settings and all scores of ``metrics.json``.

    Pictures are made before the first step, every ``trainer.image_every`` steps and after the last. They do not change
    the training.
    """

    def __init__(self, config: RunLogger.Config, run: Path, step: int):
        super().__init__(run, name="", version="tensorboard", purge_step=step + 1 if step else 0)
        self.resumed = step > 0

    def open(self) -> None:
        if not self.resumed:
            self.experiment.add_custom_scalars(layout())

    def log_pictures(self, pictures: Mapping[str, Tensor], step: int) -> None:
        for name, picture in pictures.items():
            self.experiment.add_image(name, picture, step, dataformats="HWC")

    def log_histograms(self, values: Mapping[str, Tensor], step: int) -> None:
        for name, numbers in values.items():
            self.experiment.add_histogram(name, numbers, step, BINS)

    def log_scores(self, settings: Mapping[str, Any], result: Mapping[str, Any]) -> None:
        """Write a run's row in the table of hyperparameters: its settings and scores.

        In a folder of its own, so that the row has no curves, and without Lightning's list of columns, which would be
        one run's: TensorBoard finds the columns, and which of them differ among the runs.
        """
        from torch.utils.tensorboard import SummaryWriter
        from torch.utils.tensorboard.summary import hparams

        step = result["steps"] + 1
        _, start, end = hparams(dict(settings), {})
        with SummaryWriter(Path(self.log_dir, "final"), purge_step=step) as writer:
            for part in (start, end):
                writer.file_writer.add_summary(part, step)
            for name, value in final(result).items():
                writer.add_scalar(name, value, step)


def layout() -> dict[str, dict[str, list]]:
    """Lay out TensorBoard's charts, alike for all runs: TensorBoard merges the layouts that it finds."""
    quality = {chart: f"{tag}$" for tag, chart in (metric.curve for metric in METRICS.values() if metric.curve)}
    quality |= {f"PSNR of the training pixels{end}": tag for end, tag in TRAIN_CHARTS.items()}
    charts = {"Quality": quality} | CHARTS
    return {title: {chart: ["Multiline", [tag]] for chart, tag in inside.items()} for title, inside in charts.items()}


class WandB(RunLogger, WandbLogger):
    """Weights & Biases, in `WANDB_DIR`, else in a folder `wandb` next to the run's (needs the extra `wandb`).

    A resumed run goes on by the id in ``RUN/wandb.txt``. Not inside the run: W&B makes links that lead out of it.
    """

    Config = WandBConfig

    def __init__(self, config: Config, run: Path, step: int):
        self.kept = run / "wandb.txt"
        super().__init__(
            name=run.name,
            save_dir=os.environ.get("WANDB_DIR") or run.parent,
            id=kept_id(self.kept) or secrets.token_hex(4),
            project=config.project,
            mode=config.mode,
            group=config.group or (run.parent.name if (run.parent / "multirun.yaml").is_file() else None),
        )

    def open(self) -> None:
        self.kept.write_text(self.experiment.id, encoding="utf-8")

    def log_pictures(self, pictures: Mapping[str, Tensor], step: int) -> None:
        for name, picture in pictures.items():
            # W&B would guess how an array is scaled.
            self.log_image(name, [Image.fromarray(to_8_bits(picture.float()).numpy())], step)

    def log_histograms(self, values: Mapping[str, Tensor], step: int) -> None:
        from wandb import Histogram

        counts = {name: np.histogram(numbers.numpy(), BINS) for name, numbers in values.items()}
        self.log_metrics({name: Histogram(np_histogram=count) for name, count in counts.items()}, step)

    def close(self) -> None:
        self.experiment.finish()  # or the next run of a sweep would go on with it


def kept_id(file: Path) -> str | None:
    """Read a service's id of a run out of a file in the run's folder; ``None`` for a new run.

    Raises:
        CheckpointError: the file holds no id.
    """
    found = file.read_text(encoding="utf-8", errors="replace") if file.is_file() else None
    if found is not None and not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", found):
        raise CheckpointError(file, repr(found), "a run's id")
    return found
