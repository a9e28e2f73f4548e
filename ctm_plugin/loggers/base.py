"""Base of loggers: Lightning's methods, and further ones for pictures, histograms and scores."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lightning.pytorch.loggers import Logger
from torch import Tensor

from ctm_plugin.metrics.table import METRICS
from ctm_plugin.settings.setting import Nothing


class RunLogger(Logger):
    """A logger of runs: a subclass of this and of one of Lightning's, in that order.

    It is called with ``(config, run, step)``: its ``Config``, the run directory, and the step that a resumed run goes
    on from, 0 in a new one; what was logged after it is logged again. It writes nothing before ``open``, which only
    the first of several processes calls. Kinds of values without a method of its own are dropped.
    """

    Config: type = Nothing

    def open(self) -> None:
        """Create the log's files or connect to its service, before the training begins."""
        if hasattr(type(self), "experiment"):
            _ = self.experiment  # Lightning's make theirs when it is asked for

    def log_metrics(self, metrics: Mapping[str, Any], step: int | None = None) -> None:
        """Log numbers by name, at a step; those that a module or a callback gave to ``self.log`` come here too.

        Validation scores, ``val/NAME``, are renamed to the tags of the metrics' curves.
        """
        if "epoch" in metrics:  # Lightning's own mark on the latter, whose steps it counts from 0
            metrics, step = {name: value for name, value in metrics.items() if name != "epoch"}, step + 1
        curves = {f"val/{name}": metric.curve[0] for name, metric in METRICS.items() if metric.curve}
        super().log_metrics({curves.get(name, name): value for name, value in metrics.items()}, step)

    def log_pictures(self, pictures: Mapping[str, Tensor], step: int) -> None:
        """Log pictures ``[H, W, 3]`` in [0, 1], by name."""

    def log_histograms(self, values: Mapping[str, Tensor], step: int) -> None:
        """Log histograms, by name, of numbers ``[N]`` in [0, 1]."""

    def log_scores(self, settings: Mapping[str, Any], result: Mapping[str, Any]) -> None:
        """Log a run's :func:`hyperparameters`, and the content of ``metrics.json``; its floats are scores.

        Scores are logged one step after the last: a run that is scored again replaces only them.
        """
        self.log_hyperparams(dict(settings))
        self.log_metrics(final(result), result["steps"] + 1)
        self.save()

    def close(self) -> None:
        """End the log, after a run's last values or when it failed."""


def final(result: Mapping[str, Any]) -> dict[str, float]:
    """Pick a run's scores out of the content of ``metrics.json``, by their names as curves."""
    return {f"final/{name}": value for name, value in result.items() if isinstance(value, float)}
