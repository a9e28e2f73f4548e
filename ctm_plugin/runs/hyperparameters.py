"""What sets a run apart from others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.color.settings import LossWeights
from ctm_plugin.settings.build import Config

PARTS = ("dataset", "backbone", "ctm", "color_space", "appearance", "loss")
"""What scores depend on."""
SAID = {f"{group}.{key}" for group in PARTS for key in ("name", "preset")}
SAID |= {"dataset.exposure", "dataset.root", "dataset.image", "loss.kind"}
"""What has a shorter name, or follows from the data set's name."""


def hyperparameters(config: Config, module: Backbone, result: Mapping[str, Any]) -> dict[str, Any]:
    """Collect what sets a run apart from others, by name, then all settings of the parts that its scores depend on.

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
        "appearance": result["appearance"],
        "loss": module.photometric.kind,
        "steps": result["steps"],
        "ctm.k": module.channels,
        "ctm.P": ctm.get("P", 0),
        "ctm.lr": ctm.get("lr", 0.0),
        **{f"ctm.weights.{term}": weights.get(term, 0.0) for term in vars(LossWeights())},
    }
    own = {key: value for group in PARTS for key, value in _flat(config[group], group) if key not in SAID}
    return {
        key: str(value).lower() if isinstance(value, bool) else value
        for key, value in (common | own).items()
        if isinstance(value, bool | int | float | str)
    }


def _flat(node: Mapping[str, Any], above: str) -> Iterator[tuple[str, Any]]:
    """Settings by dotted keys."""
    for key, value in node.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{above}.{key}")
        else:
            yield f"{above}.{key}", value
