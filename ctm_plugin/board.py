"""What TensorBoard is told of a run beside curves and pictures: charts, and settings with the scores they led to."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.plugins.hparams import api_pb2 as api
from tensorboard.plugins.hparams.metadata import EXPERIMENT_TAG, NULL_TENSOR, create_summary_metadata
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.color.ctm import LossWeights
from ctm_plugin.config import Config
from ctm_plugin.metrics.table import METRICS, told_at

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
"""Charts of regular expressions over tags, beside those of metrics."""

VARIED = ("backbone", "ctm", "dataset", "exposure", "seed")
"""Settings that the table shows unless others are chosen."""


def layout() -> dict[str, dict[str, list]]:
    """All charts. The same for all runs: TensorBoard merges the layouts that it finds."""
    curves = [metric.curve for metric in METRICS.values() if metric.curve]
    of_metrics = {chart: ["Multiline", [f"{tag}$"]] for tag, chart in curves}
    return LAYOUT | {"Quality": of_metrics | LAYOUT["Quality"]}


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


def write_scores(folder: Path, settings: Mapping[str, Any], result: Mapping[str, Any]) -> None:
    """A run's row in TensorBoard's table of hyperparameters: its settings, and as ``final/NAME`` its scores.

    They stand one step after the last one: a run that is scored again replaces them, and nothing else. TensorBoard
    takes the names of the columns from any one of the runs, and draws only runs that have a value in each one shown.

    Args:
        folder: the run's events.
        settings: see :func:`hyperparameters`.
        result: what ``metrics.json`` holds; its floats are scores.
    """
    numbers = {name: value for name, value in result.items() if isinstance(value, float)}
    told = told_at("run")
    names = [*(name for name in told if name in numbers), *(name for name in numbers if name not in told)]
    columns = [
        api.HParamInfo(
            name=name,
            type=api.DATA_TYPE_STRING if isinstance(value, str) else api.DATA_TYPE_FLOAT64,
            differs=name in VARIED,
        )
        for name, value in settings.items()
    ]
    scores = [api.MetricInfo(name=api.MetricName(tag=f"final/{name}"), display_name=name) for name in names]
    # PyTorch's own has neither names to display nor a choice of columns.
    metadata = create_summary_metadata(
        HParamsPluginData(experiment=api.Experiment(hparam_infos=columns, metric_infos=scores))
    )
    experiment = Summary(value=[Summary.Value(tag=EXPERIMENT_TAG, metadata=metadata, tensor=NULL_TENSOR)])
    _, start, end = hparams(dict(settings), {})
    step = result["steps"] + 1
    with SummaryWriter(folder, purge_step=step) as writer:
        for part in (experiment, start, end):
            writer.file_writer.add_summary(part, step)
        for name, value in numbers.items():
            writer.add_scalar(f"final/{name}", value, step)
