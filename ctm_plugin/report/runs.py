"""A run directory, read for a report."""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from ctm_plugin.errors import CheckpointError
from ctm_plugin.metrics.summary import is_measurement
from ctm_plugin.runs.safe_read import read_json, read_yaml
from ctm_plugin.settings.check import is_number

CONFIG, METRICS = "config.yaml", "metrics.json"
BACKGROUNDS = "dataset.background_level"
"""Keys that only concern training, as test views are on a black background: a transform may have its own."""
BUDGET, GEOMETRY = "trainer.budget", "dataset.geometry"
EVERYWHERE = (BUDGET, GEOMETRY, "dataset.near", "dataset.far", "loss.weight", "metrics.lpips_net")
"""What all runs may share, whatever their backbone; of the data: what changes no test picture."""
LARGEST = 1e9
"""What no score reaches."""


class Setting(NamedTuple):
    """What the paper's tables vary; what is not said is the paper's own choice."""

    backbone: str
    ctm: str
    """The preset; ``off`` without CTM."""
    color_space: str = "rgb"
    loss: str = "mse"
    without: frozenset[str] = frozenset()
    """CTM's terms of weight 0 that its preset weighs."""
    P: int | None = None
    k: int | None = None
    encoding: str | None = None
    appearance: str = "none"
    others: tuple[tuple[str, str], ...] = ()
    """Keys and values in which runs of one report differ besides, see :func:`~ctm_plugin.report.apart.set_apart`."""


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        folder: where it is.
        config, metrics: what its files say.
        setting: what a table may vary.
        rest: the other settings that its scores depend on, plain containers.
    """

    folder: Path
    config: dict[str, Any]
    metrics: dict[str, Any]
    setting: Setting
    rest: dict[str, Any]

    @property
    def scene(self) -> str:
        return self.metrics["dataset"]

    @property
    def seed(self) -> int:
        return self.config["seed"]

    @property
    def level(self) -> float | str | None:
        """Of random backgrounds."""
        return self.rest[BACKGROUNDS]

    @property
    def aligned(self) -> bool:
        """Whether it is of patches that were aligned, not of views."""
        return is_aligned(self.metrics)

    @property
    def converged(self) -> bool:
        return self.metrics.get("converged") is not False

    @property
    def measured(self) -> bool:
        """Whether its budget is more than a test of the command."""
        return self.metrics.get("measured", is_measurement(self.config)) is not False

    def value(self, metric: str) -> float | None:
        """A score; ``None`` where it is none, NaN included, or so large that means would overflow."""
        value = self.metrics.get(metric)
        return float(value) if is_number(value) and abs(value) < LARGEST else None


def has_appearances(runs: Sequence[Run]) -> bool:
    """Whether some runs hold apart how their pictures were exposed."""
    return any(run.setting.appearance != "none" for run in runs)


def is_aligned(metrics: dict[str, Any]) -> bool:
    return "warp_error" in metrics


def read_run(folder: Path) -> Run:
    """One finished run; nothing in its files is interpreted.

    Raises:
        CheckpointError: a file cannot be read, or says too little.
    """
    config, metrics = read_yaml(folder / CONFIG), read_json(folder / METRICS)
    missing = [key for key in ("protocol", "dataset", "steps") if key not in metrics]
    if missing:
        raise CheckpointError(folder / METRICS, f"nothing for {', '.join(missing)}", "a run's scores")
    try:
        check_metrics(metrics)
    except ValueError as error:
        raise CheckpointError(folder / METRICS, f"a gap ({error})", "a run's scores") from error
    try:
        run = Run(folder, config, metrics, setting_of(config, is_aligned(metrics)), rest_of(config))
        _check("seed", config["seed"], isinstance(config["seed"], int) and config["seed"] >= 0)
        for key, value in (
            ("backbone.geometry", run.rest["backbone"].get("geometry")),
            (BACKGROUNDS, run.rest[BACKGROUNDS]),
        ):
            _check(key, value, value is None or isinstance(value, str | int | float))
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise CheckpointError(folder / CONFIG, f"a gap ({error})", "a run's configuration") from error
    return run


def _check(key: str, value: Any, good: bool) -> None:
    if not good:
        raise ValueError(f"{key} is {reprlib.repr(value)}")


def check_metrics(metrics: dict[str, Any]) -> None:
    """Refuse scores with names that are none; a view's is that of a file in ``test/``.

    Raises:
        ValueError: there is such a name.
    """
    for key in ("protocol", "dataset"):
        _check(key, metrics[key], isinstance(metrics[key], str))
    _check("steps", metrics["steps"], isinstance(metrics["steps"], int))
    net = metrics.get("lpips_net")
    _check("lpips_net", net, net is None or isinstance(net, str))
    rows = metrics.get("per_image") or []
    _check("per_image", rows, isinstance(rows, list))
    for row in rows:
        name = row.get("name") if isinstance(row, dict) else None
        _check("a view's name", name, isinstance(name, str) and name not in ("", "..") and Path(name).name == name)


def setting_of(config: dict[str, Any], aligned: bool) -> Setting:
    """What a table may vary, of the configuration of a run of views, or of patches that were ``aligned``.

    Raises:
        KeyError, TypeError, AttributeError, ValueError: it is no run's.
    """
    setting = _setting_of(config, aligned)
    for key, value in setting._asdict().items():
        if key in ("P", "k"):
            _check(f"ctm.{key}", value, value is None or isinstance(value, int))
        elif key not in ("without", "others"):
            _check(key, value, isinstance(value, str) or (key == "encoding" and value is None))
    return setting


def _loss(config: dict[str, Any]) -> Any:
    """The distance between colours, ``mse`` where it is the one that goes with them anyway."""
    kind, own = config["loss"]["kind"], config["ctm"].get("photometric", "mse")
    if own == "mse":
        return kind
    return "mse" if kind == own else f"{kind}, said"


def _setting_of(config: dict[str, Any], aligned: bool) -> Setting:
    backbone, ctm, space = config["backbone"], config["ctm"], dict(config["color_space"])
    common = {
        "backbone": backbone["name"],
        "color_space": " ".join([space.pop("name"), *(f"{key}={value}" for key, value in space.items())]),
        "loss": _loss(config),
        "encoding": backbone.get("encoding"),
        "appearance": config["appearance"]["name"],
    }
    if ctm["name"] == "none":
        return Setting(ctm="off", **common)
    # An alignment has no use for the random colours: there their weights are 0 in every preset.
    weighed = ("enc", "dec", "img") if aligned else ("enc", "dec", "img", "rand", "latent")
    without = frozenset(term for term in weighed if ctm.get("weights", {}).get(term) == 0)
    return Setting(ctm=ctm.get("preset", ctm["name"]), without=without, P=ctm.get("P"), k=ctm.get("k"), **common)


def rest_of(config: dict[str, Any]) -> dict[str, Any]:
    """Everything else that scores depend on: without seeds, paths, and how often something is logged."""
    ctm = {key: value for key, value in config["ctm"].items() if key not in ("P", "k", "weights")}
    ctm["weights"] = {term: weight for term, weight in config["ctm"].get("weights", {}).items() if weight}
    dataset, trainer = config["dataset"], config["trainer"]
    elsewhere = ("root", "image", "seed", "scene", "background_level", "geometry", "near", "far")
    return {
        "backbone": {key: value for key, value in config["backbone"].items() if key != "encoding"},
        "ctm": ctm,
        "appearance": config["appearance"],
        "loss.weight": config["loss"].get("weight"),
        "metrics.lpips_net": config.get("metrics", {}).get("lpips_net"),
        "dataset": {key: value for key, value in dataset.items() if key not in elsewhere},
        **{f"dataset.{key}": dataset.get(key) for key in ("geometry", "near", "far", "background_level")},
        BUDGET: trainer.get("budget"),
        "trainer": {key: trainer.get(key) for key in ("precision", "accumulate_grad_batches", "gradient_clip_val")},
    }
