"""What a run tells its logger: curves by Lightning's own methods, and what Lightning has no method for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from lightning.pytorch.loggers import Logger
from torch import Tensor

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.color.ctm import LossWeights
from ctm_plugin.config import Config

BINS = np.linspace(0, 1, 65)
"""Edges of the histograms."""


class RunLogger(Logger):
    """A logger of runs: a subclass of this and of one of Lightning's, in that order.

    It is called with ``(config, run, step)``: its ``Config``, the run directory, and the step that a resumed run goes
    on from, 0 in a new one; what was logged after it is logged again. It writes nothing before its ``experiment`` is
    asked for, which only the first of several processes does. What it has no method for, it drops.
    """

    @dataclass(frozen=True, kw_only=True)
    class Config:
        """No settings."""

    def log_metrics(self, metrics: Mapping[str, Any], step: int | None = None) -> None:
        """Numbers by name, at a step; those that a module or a callback gave to ``self.log`` come here too."""
        if "epoch" in metrics:  # Lightning's own mark on the latter, whose steps it counts from 0
            metrics, step = {name: value for name, value in metrics.items() if name != "epoch"}, step + 1
        super().log_metrics(metrics, step)

    def log_pictures(self, pictures: Mapping[str, Tensor], step: int) -> None:
        """Pictures ``[H, W, 3]`` in [0, 1], by name."""

    def log_histograms(self, values: Mapping[str, Tensor], step: int) -> None:
        """Numbers in [0, 1], ``[N]``, by name; to be counted between :data:`BINS`."""

    def log_scores(self, settings: Mapping[str, Any], result: Mapping[str, Any]) -> None:
        """What set a run apart (:func:`hyperparameters`), and what ``metrics.json`` holds; its floats are scores.

        They stand one step after the last one: a run that is scored again replaces them, and nothing else.
        """
        self.log_hyperparams(dict(settings))
        self.log_metrics({f"final/{name}": value for name, value in floats(result).items()}, result["steps"] + 1)
        self.save()

    def close(self) -> None:
        """Nothing more will come, be it that the run failed."""


def floats(result: Mapping[str, Any]) -> dict[str, float]:
    """The scores of a run among what ``metrics.json`` holds."""
    return {name: value for name, value in result.items() if isinstance(value, float)}


def hyperparameters(config: Config, module: Backbone, result: Mapping[str, Any]) -> dict[str, Any]:
    """What sets a run apart from others, by name, then the backbone's own settings.

    Without CTM its weights and frequencies are 0, so that runs without it have a place on every axis.
    """
    ctm, weights = config["ctm"], config["ctm"].get("weights")
    weights = weights if isinstance(weights, Mapping) else {}
    exposure = getattr(getattr(module, "scene", None), "exposure", None)
    common = {
        "dataset": result["dataset"],
        "backbone": result["backbone"],
        "ctm": result["ctm"],
        "seed": config["seed"],
        "exposure": config["dataset"].get("exposure", 1.0) if exposure is None else exposure,
        "color_space": result["color_space"],
        "loss": module.photometric.kind,
        "steps": result["steps"],
        "ctm.k": module.channels,
        "ctm.P": ctm.get("P", 0),
        "ctm.lr": ctm.get("lr", 0.0),
        **{f"ctm.weights.{term}": weights.get(term, 0.0) for term in vars(LossWeights())},
    }
    of = ("backbone", "color_space")
    own = {f"{group}.{key}": value for group in of for key, value in config[group].items() if key != "name"}
    return {
        key: str(value).lower() if isinstance(value, bool) else value
        for key, value in (common | own).items()
        if isinstance(value, bool | int | float | str)
    }
