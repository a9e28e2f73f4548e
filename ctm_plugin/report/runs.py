"""Reading of finished runs below folders, with the reasons why others are left out."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctm_plugin.errors import CheckpointError, printable
from ctm_plugin.runs.rundir import CONFIG, ERROR, METRICS, read_json, read_yaml
from ctm_plugin.settings.listing import leaves
from ctm_plugin.settings.setting import is_number

MAX_ERROR = 10_000
"""Most characters of a failed run's error that are shown."""
MAX_SCORE = 1e9
"""Bound on scores: larger numbers count as missing."""
LOSS_TERMS = ("enc", "dec", "img", "rand", "latent")
"""Names of the terms of CTM's loss."""
CHOICE_KEYS = {"backbone": "name", "ctm": "name", "color_space": "name", "loss": "kind", "appearance": "name"}
"""Sections of a configuration and their key that names the choice."""
LOCATION_KEYS = {
    "backbone.encoding",
    "ctm.P",
    "ctm.k",
    *(f"dataset.{key}" for key in ("root", "image", "seed", "scene")),
}
"""Keys left out of a run's ``rest``: places of the data, and keys that its ``setting`` has already."""
Setting = dict[str, str | None]
"""A run's setting: keys of a command line and their values; ``None``: the preset's value."""


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        folder: the run's directory.
        config, metrics: contents of ``config.yaml`` and ``metrics.json``.
        setting: values of keys that the paper's tables vary; after :func:`~ctm_plugin.report.labels.find_runs` also
            of all other keys in which runs of one report differ.
        rest: all other settings that the run's scores depend on, as text by dotted key.
        label: the setting's name among other runs.
    """

    folder: Path
    config: dict[str, Any]
    metrics: dict[str, Any]
    setting: Setting
    rest: dict[str, str]
    label: str = ""

    @property
    def scene(self) -> str:
        return self.metrics["dataset"]

    @property
    def seed(self) -> int:
        return self.config["seed"]

    @property
    def key(self) -> tuple:
        """The setting as a hashable tuple, to group runs by."""
        return tuple(self.setting.items())

    @property
    def converged(self) -> bool:
        return self.metrics.get("converged") is not False

    def value(self, metric: str) -> float | None:
        """A metric's value; ``None`` where it is missing, NaN, or so large that means would overflow."""
        value = self.metrics.get(metric)
        return float(value) if is_number(value) and abs(value) < MAX_SCORE else None


def read_runs(folders: Sequence[Path]) -> tuple[list[Run], list[str]]:
    """Read all runs in folders and below them, and tell why others are left out.

    Raises:
        CheckpointError: a folder is missing or holds no run.
    """
    runs_by_folder: dict[Path, Run | str] = {}
    for folder in folders:
        paths = sorted({path.parent for name in (CONFIG, ERROR) for path in folder.rglob(name)})
        if not paths:
            why = f"no {CONFIG} in it or below" if folder.is_dir() else "no such directory"
            raise CheckpointError(folder, why, "a run directory, or a folder of them")
        for run in paths:
            if run.resolve() not in runs_by_folder:
                runs_by_folder[run.resolve()] = _run_or_reason(run)
    runs = [run for run in runs_by_folder.values() if isinstance(run, Run)]
    return runs, [why for why in runs_by_folder.values() if isinstance(why, str)]


def _run_or_reason(folder: Path) -> Run | str:
    try:
        if (folder / METRICS).exists():
            return read_run(folder)
    except CheckpointError as error:
        return str(error)
    if not (folder / ERROR).is_file():
        return f"{folder.resolve()}: not finished"
    with (folder / ERROR).open(encoding="utf-8", errors="replace") as file:
        return "\n".join(printable(line) for line in f"{folder.resolve()}: {file.read(MAX_ERROR).strip()}".splitlines())


def read_run(folder: Path) -> Run:
    """Read one finished run; nothing in its files is executed.

    Raises:
        CheckpointError: a file cannot be read, or lacks a value.
    """
    config, metrics = read_yaml(folder / CONFIG), read_json(folder / METRICS)
    if missing := [key for key in ("protocol", "dataset", "steps") if key not in metrics]:
        raise CheckpointError(folder / METRICS, f"nothing for {', '.join(missing)}", "a run's scores")
    file, expected = METRICS, "a run's scores"
    try:
        _check_metrics(metrics)
        file, expected = CONFIG, "a run's configuration"
        _check("seed", config["seed"], isinstance(config["seed"], int) and config["seed"] >= 0)
        for section, key in CHOICE_KEYS.items():
            _check(f"{section}.{key}", config[section][key], isinstance(config[section][key], str))
        return Run(folder, config, metrics, _setting(config, "warp_error" in metrics), _rest(config))
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise CheckpointError(folder / file, f"a gap ({error})", expected) from error


def _check(key: str, value: Any, good: bool) -> None:
    if not good:
        raise ValueError(f"{key} is {reprlib.repr(value)}")


def _check_metrics(metrics: Mapping[str, Any]) -> None:
    for key, kind in {"protocol": str, "dataset": str, "steps": int, "lpips_net": str, "per_image": list}.items():
        value = metrics.get(key)
        _check(key, value, isinstance(value, kind) or (value is None and key in ("lpips_net", "per_image")))
    for row in metrics.get("per_image") or []:  # views have the names of files
        name = row.get("name") if isinstance(row, dict) else None
        _check("a view's name", name, isinstance(name, str) and name not in ("", "..") and Path(name).name == name)


def _setting(config: Mapping[str, Any], aligned: bool) -> Setting:
    """Read a run's setting, the keys that the paper's tables vary; ``aligned``: it is a run of aligned patches."""
    ctm, space, loss = config["ctm"], dict(config["color_space"]), config["loss"]["kind"]
    setting: Setting = {
        "backbone": config["backbone"]["name"],
        "ctm": preset_of(config),
        "color_space": " ".join([space.pop("name"), *(f"{key}={value}" for key, value in space.items())]),
        "loss": None if loss == ctm.get("photometric", "mse") else loss,
        "appearance": config["appearance"]["name"],
    }
    sizes, terms = {"backbone.encoding": config["backbone"].get("encoding")}, {}
    if setting["ctm"] != "off":
        sizes |= {"ctm.P": ctm.get("P"), "ctm.k": ctm.get("k")}
        # An alignment has no use for the random colours: there their weights are 0 in every preset.
        zeros = {term for term, weight in ctm.get("weights", {}).items() if weight == 0}
        zeros -= {"rand", "latent"} if aligned else set()
        terms = {f"ctm.weights.{term}": "0" if term in zeros else None for term in LOSS_TERMS}
    return setting | {key: str(value) for key, value in sizes.items() if value is not None} | terms


def preset_of(config: Mapping[str, Any]) -> str:
    """Name of the transform's choice of ``ctm``, ``off`` for none."""
    name = config["ctm"]["name"]
    preset = "off" if name == "none" else config["ctm"].get("preset", name)
    _check("ctm.preset", preset, isinstance(preset, str))
    return preset


def _rest(config: Mapping[str, Any]) -> dict[str, str]:
    """All other settings that scores depend on, by dotted key: without seeds, paths and logging intervals."""
    values = dict(leaves({section: config[section] for section in ("backbone", "ctm", "appearance", "dataset")}))
    for section, keys in {
        "dataset": ("geometry", "near", "far", "background_level"),
        "loss": ("weight",),
        "metrics": ("lpips_net",),
        "trainer": ("budget", "precision", "accumulate_grad_batches", "gradient_clip_val"),
    }.items():
        values |= {f"{section}.{key}": config.get(section, {}).get(key) for key in keys}
    none = {key for key, weight in weights(values).items() if not weight}
    return {key: _as_typed(value) for key, value in values.items() if key not in LOCATION_KEYS | none}


def _as_typed(value: Any) -> str:
    """Text of a value as on a command line; 1 and 1.0 are the same."""
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    return str(int(value)) if is_number(value) and value == value // 1 else str(value)


def weights(keys: Mapping[str, Any]) -> dict[str, Any]:
    """Weights of CTM's loss terms, out of the keys of ``ctm``."""
    return {key: value for key, value in keys.items() if key.startswith("ctm.weights.")}
