"""TensorBoard: a run's curves, pictures and histograms, charts of them, and settings with the scores they led to."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.loggers.logger import rank_zero_experiment
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from ctm_plugin.loggers.base import BINS, RunLogger, floats
from ctm_plugin.metrics.table import METRICS

LAYOUT = {
    "Quality": {
        "PSNR of the training pixels": ["Multiline", [r"psnr/rgb$"]],
        "PSNR of the training pixels in the latent space": ["Multiline", [r"psnr/latent$"]],
    },
    "Losses": {
        "on colours: color without CTM, enc and dec with it": ["Multiline", [r"loss/(color|enc|dec)$"]],
        "CTM's cycles": ["Multiline", [r"loss/(img|rand|latent)$"]],
        "the backbone's own": ["Multiline", [r"loss/(?!(color|enc|dec|img|rand|latent|total)$)"]],
        "total": ["Multiline", [r"loss/total$"]],
    },
    "Learning rates": {"of the field and of CTM": ["Multiline", [r"lr/"]]},
    "Speed": {
        "milliseconds a step": ["Multiline", [r"speed/ms_per_step$"]],
        "rays a second": ["Multiline", [r"speed/rays_per_second$"]],
    },
    "Field": {"the backbone's own numbers": ["Multiline", [r"field/"]]},
}
"""Charts of regular expressions over tags, in addition to those of metrics."""


def layout() -> dict[str, dict[str, list]]:
    """Lay out all charts. The same for all runs: TensorBoard merges the layouts that it finds."""
    curves = [metric.curve for metric in METRICS.values() if metric.curve]
    of_metrics = {chart: ["Multiline", [f"{tag}$"]] for tag, chart in curves}
    return LAYOUT | {"Quality": of_metrics | LAYOUT["Quality"]}


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
        super().__init__(run, name="", version=EVENTS, purge_step=step + 1 if step else 0)
        self.charted = step > 0

    @property
    @rank_zero_experiment
    def experiment(self) -> SummaryWriter:
        writer = super().experiment
        if not self.charted:
            writer.add_custom_scalars(layout())
            self.charted = True
        return writer

    def log_pictures(self, pictures: Mapping[str, Tensor], step: int) -> None:
        for name, picture in pictures.items():
            self.experiment.add_image(name, picture, step, dataformats="HWC")

    def log_histograms(self, values: Mapping[str, Tensor], step: int) -> None:
        for name, numbers in values.items():
            self.experiment.add_histogram(name, numbers, step, BINS)

    def log_scores(self, settings: Mapping[str, Any], result: Mapping[str, Any]) -> None:
        """Write a run's row in the table of hyperparameters: its settings, and as ``final/NAME`` its scores.

        In a folder of its own, so that the row has only scores, no curves. TensorBoard finds the columns, and which
        of them differ among the runs.
        """
        step = result["steps"] + 1
        _, start, end = hparams(dict(settings), {})
        with SummaryWriter(Path(self.log_dir, ROW), purge_step=step) as writer:
            for part in (start, end):
                writer.file_writer.add_summary(part, step)
            for name, value in floats(result).items():
                writer.add_scalar(f"final/{name}", value, step)


EVENTS = "tensorboard"
ROW = "final"
