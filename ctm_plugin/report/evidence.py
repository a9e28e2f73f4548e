"""Runs as rows of ``docs/evidence/scores.csv``: what each was, the command that makes it again, its scores."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ctm_plugin.errors import DataError
from ctm_plugin.metrics.table import METRICS
from ctm_plugin.report.runs import Run, leaves, preset_of
from ctm_plugin.runs.compose import compose

SETTINGS = ("scene", "light", "backbone", "colours", "variant", "geometry", "background", "budget", "size")
SAME = (*SETTINGS, "seed", "device", "commit")
"""What two rows of one run share."""
SCORES = {"psnr_brightened": "psnr_enhanced", "depth_error": "depth_mae", "seconds": "train_seconds"}
"""Columns whose score ``metrics.json`` has by another name."""
COLUMNS = (
    *(*SAME, "command", "psnr", "psnr_brightened", "ssim", "lpips", "psnr_lit", "ssim_lit", "lpips_lit"),
    *("depth_error", "corner_error", "seconds"),
)
TOLD = ("light", "exposure", "background", "geometry", "downscale", "width", "height", "factor", "patch")
"""Keys of a data set that columns of their own tell."""
ROOT, FOLDERS = "CTM_DATA", ("root", "image", "scene", "images", "masks", "lit", "dark")
"""The variable in commands, and keys that say where pictures lie."""
USUAL = {"color_space": "rgb", "appearance": "none"}
"""Choices that are not said."""
SECTIONS = ("dataset", "color_space", "appearance", "loss", "backbone", "ctm")


def evidence(runs: Sequence[Run], path: Path | None = None) -> str:
    """The rows of runs as CSV, behind those that ``path`` holds already: there a run's own row is replaced.

    Other columns of the file stay, and are filled where ``metrics.json`` has a score of their name.

    Raises:
        DataError: the file is no table of scores.
    """
    columns, rows = _read(path) if path is not None and path.is_file() else (COLUMNS, [])
    for run in runs:
        row = row_of(run, columns)
        same = (index for index, old in enumerate(rows) if all(old[key] == row[key] for key in SAME))
        if (index := next(same, None)) is None:
            rows.append(row)
        else:
            rows[index] = row
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _read(path: Path) -> tuple[Sequence[str], list[dict[str, str]]]:
    with path.open(encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file, restval="")
        columns, rows = reader.fieldnames or (), list(reader)
    if missing := set(COLUMNS) - set(columns):
        raise DataError(path, f"no column {min(missing)}", f"a table of scores with the columns {', '.join(COLUMNS)}")
    return columns, rows


def row_of(run: Run, columns: Sequence[str] = COLUMNS) -> dict[str, str]:
    """A run as text by column; empty where it has nothing to say."""
    config, metrics = run.config, run.metrics
    given = list(_given(config))
    size = re.search(r"\d+x\d+", metrics["protocol"].removeprefix(run.scene))
    light = _light(config["dataset"], metrics)
    row = {
        "scene": run.scene.removesuffix(f"_{light}"),
        "light": light,
        "backbone": config["backbone"]["name"],
        "colours": config["color_space"]["name"] if run.setting["ctm"] == "off" else run.setting["ctm"],
        "variant": " ".join(f"{key.rpartition('.')[2]}={value}" for key, value in _variant(config, given)),
        "geometry": config["dataset"].get("geometry") or "",
        "background": config["dataset"].get("background") or "",
        "budget": config["trainer"].get("budget") or "",
        "size": size[0] if size else "",
        "seed": str(run.seed),
        "device": _device(config, metrics),
        "commit": metrics.get("version", "").partition(" ")[2][:7],
        "command": _command(config, given),
    }
    return {column: row[column] if column in row else _score(run, SCORES.get(column, column)) for column in columns}


def _score(run: Run, name: str) -> str:
    value, metric = run.value(name), METRICS.get(name)
    if value is None or metric is None:
        return ""
    return f"{value:.{metric.decimals + 2}f}" if run.converged or not metric.of else "N.C."


def _light(dataset: Mapping[str, Any], metrics: Mapping[str, Any]) -> str:
    """Dark or lit, or the share of normal light where it is known."""
    exposure = dataset.get("exposure")
    if isinstance(dataset.get("light"), str):
        return dataset["light"]
    if isinstance(exposure, int | float):
        return "lit" if exposure == 1 else f"{exposure:g}"
    return "dark" if (metrics.get("enhancement_gain") or 1) > 2 else "lit"


def _device(config: Mapping[str, Any], metrics: Mapping[str, Any]) -> str:
    """What it was scored on; of runs that do not say so, CPU where there was no other."""
    torch = metrics.get("versions", {}).get("torch", "")
    on_cpu = config["trainer"].get("accelerator") == "cpu" or torch.endswith("+cpu")
    return metrics.get("device") or ("CPU" if on_cpu else "")


def _given(config: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Keys of a configuration that differ from those of its choices, as people type them."""
    choices = _choices(config)
    near = {"dataset.geometry": config["dataset"].get("geometry")}
    usual = compose(*(f"{key}={value}" for key, value in (choices | near).items() if value is not None))
    there = dict(leaves({section: usual[section] for section in SECTIONS}))
    for key, value in leaves({section: config[section] for section in SECTIONS}):
        own = key.rpartition(".")[2] in ("name", "preset") or key == "dataset.seed"
        if not own and (value != there.get(key) or key in near):
            yield key, value if isinstance(value, str) else json.dumps(value).replace(" ", "")


def _choices(config: Mapping[str, Any]) -> dict[str, str]:
    names = {section: config[section]["name"] for section in ("dataset", "backbone", "color_space", "appearance")}
    return names | {"ctm": preset_of(config), "trainer": config["trainer"].get("budget")}


def _variant(config: Mapping[str, Any], given: Sequence[tuple[str, str]]) -> Iterator[tuple[str, str]]:
    """Keys that no other column tells."""
    for key, usual in USUAL.items():
        if config[key]["name"] != usual and not (key == "color_space" and preset_of(config) == "off"):
            yield key, config[key]["name"]
    told = {f"dataset.{name}" for name in (*TOLD, *FOLDERS)}
    yield from ((key, value) for key, value in given if key not in told)


def _command(config: Mapping[str, Any], given: Sequence[tuple[str, str]]) -> str:
    words = [(key, value) for key, value in _choices(config).items() if value not in (None, USUAL.get(key))]
    return " ".join(["ctm", *(_word(key, value) for key, value in (*words, *given)), f"seed={config['seed']}"])


def _word(key: str, value: str) -> str:
    data = os.environ.get(ROOT)
    if key.rpartition(".")[2] in FOLDERS and data and Path(value).is_absolute():
        folder = Path(value).resolve()
        if folder.is_relative_to(Path(data).resolve()):
            return f"{key}=${ROOT}/{shlex.quote(folder.relative_to(Path(data).resolve()).as_posix())}"
    return shlex.quote(f"{key}={value}")
