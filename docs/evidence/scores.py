"""Runs as rows of ``scores.csv``: what each was, the command that makes it again, its scores.

``python docs/evidence/scores.py RUNS... [out=FILE]`` adds a row for each run in the folders to a table of scores, or
prints them.
"""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

from ctm_plugin.compose.command_line import compose
from ctm_plugin.errors import CTMError, DataError
from ctm_plugin.files import write_text
from ctm_plugin.metrics.table import METRICS
from ctm_plugin.report.labels import UNNAMED_VALUES
from ctm_plugin.report.runs import Run, preset_of, read_runs
from ctm_plugin.settings.listing import leaves

SETTING_COLUMNS = ("scene", "light", "backbone", "colours", "variant", "geometry", "background", "budget", "size")
"""Columns that say what was run."""
KEY_COLUMNS = (*SETTING_COLUMNS, "seed", "device", "commit")
"""Columns whose values two rows of one run share."""
ALIASES = {"psnr_brightened": "psnr_enhanced", "depth_error": "depth_mae", "seconds": "train_seconds"}
"""Names in ``metrics.json`` of the scores that columns call otherwise."""
COLUMNS = (
    *(*KEY_COLUMNS, "command", "psnr", "psnr_brightened", "ssim", "lpips", "psnr_lit", "ssim_lit", "lpips_lit"),
    *("depth_error", "corner_error", "seconds"),
)
"""All columns in their order."""
ROOT_VARIABLE, FOLDER_KEYS = "CTM_DATA", ("root", "image", "scene", "images", "masks", "lit", "dark")
"""Environment variable that stands for the data's folder in commands, and the keys that name folders."""
COLUMN_KEYS = (
    "light",
    "exposure",
    "background",
    "geometry",
    "downscale",
    "width",
    "height",
    "factor",
    "patch",
    *FOLDER_KEYS,
)
"""Keys of a data set that have columns of their own."""
VARIANT_SECTIONS = ("dataset", "color_space", "appearance", "loss", "backbone", "ctm")
"""Sections whose keys make up the column ``variant``."""


def evidence(runs: Sequence[Run], path: Path | None = None) -> str:
    """The rows of runs as CSV, behind those that ``path`` holds already: there a run's own row is replaced.

    Other columns of the file stay, and are filled where ``metrics.json`` has a score of their name.

    Raises:
        DataError: the file is no table of scores.
    """
    columns, rows = COLUMNS, []
    if path is not None and path.is_file():
        with path.open(encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file, restval="")
            columns, rows = reader.fieldnames or (), list(reader)
        if missing := set(COLUMNS) - set(columns):
            expected = f"a table of scores with the columns {', '.join(COLUMNS)}"
            raise DataError(path, f"no column {min(missing)}", expected)
    same = itemgetter(*KEY_COLUMNS)
    new = {same(row): row for row in (row_of(run, columns) for run in runs)}
    rows = [*(new.pop(same(row), row) for row in rows), *new.values()]
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def row_of(run: Run, columns: Sequence[str] = COLUMNS) -> dict[str, str]:
    """A run as text by column; empty where it has nothing to say."""
    config, metrics, dataset, trainer = run.config, run.metrics, run.config["dataset"], run.config["trainer"]
    choices, given = _choices(config), list(_given(config))
    size = re.search(r"\d+x\d+", metrics["protocol"].removeprefix(run.scene))
    torch = metrics.get("versions", {}).get("torch", "")
    light = _light(dataset, metrics)
    named = [(key, value) for key, value in choices.items() if value not in (None, UNNAMED_VALUES.get(key))]
    words = [*(_word(*each) for each in (*named, *given)), f"seed={run.seed}"]
    own = {"appearance"} if choices["ctm"] == "off" else {"color_space", "appearance"}
    variant = [(key, value) for key, value in named if key in own]
    variant += [(key, value) for key, value in given if key not in {f"dataset.{name}" for name in COLUMN_KEYS}]
    row = {
        "scene": run.scene.removesuffix(f"_{light}"),
        "light": light,
        "backbone": choices["backbone"],
        "colours": choices["color_space"] if choices["ctm"] == "off" else choices["ctm"],
        "variant": " ".join(f"{key.rpartition('.')[2]}={value}" for key, value in variant),
        "geometry": dataset.get("geometry") or "",
        "background": dataset.get("background") or "",
        "budget": trainer.get("budget") or "",
        "size": size[0] if size else "",
        "seed": str(run.seed),
        # Of runs that do not say so, CPU where there was no other.
        "device": metrics.get("device")
        or ("CPU" if trainer.get("accelerator") == "cpu" or torch.endswith("+cpu") else ""),
        "commit": metrics.get("version", "").partition(" ")[2][:7],
        "command": " ".join(["ctm", *words]),
    }
    return {column: row[column] if column in row else _score(run, ALIASES.get(column, column)) for column in columns}


def _score(run: Run, name: str) -> str:
    value, metric = run.value(name), METRICS.get(name)
    if value is None or metric is None:
        return ""
    return f"{value:.{metric.decimals + 2}f}" if run.converged or not metric.of else "N.C."


def _light(dataset: Mapping[str, Any], metrics: Mapping[str, Any]) -> str:
    """The light's name, or the share of normal light by which pictures were dimmed; else dark or lit, as they are."""
    light, exposure = dataset.get("light"), dataset.get("exposure")
    if isinstance(light, str):
        return light
    if isinstance(exposure, int | float) and exposure != 1:
        return f"{exposure:g}"
    return "dark" if (metrics.get("light_factor") or metrics.get("enhancement_gain") or 1) > 2 else "lit"


def _choices(config: Mapping[str, Any]) -> dict[str, str]:
    names = {section: config[section]["name"] for section in ("dataset", "backbone", "color_space", "appearance")}
    return names | {"ctm": preset_of(config), "trainer": config["trainer"].get("budget")}


def _given(config: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Keys of a configuration that differ from those of its choices, as people type them."""
    near = {"dataset.geometry": config["dataset"].get("geometry")}
    usual = compose(*(f"{key}={value}" for key, value in (_choices(config) | near).items() if value is not None))
    there = dict(leaves({section: usual[section] for section in VARIANT_SECTIONS}))
    for key, value in leaves({section: config[section] for section in VARIANT_SECTIONS}):
        own = key.rpartition(".")[2] in ("name", "preset") or key == "dataset.seed"
        if not own and (value != there.get(key) or key in near):
            yield key, value if isinstance(value, str) else json.dumps(value).replace(" ", "")


def _word(key: str, value: str) -> str:
    data = os.environ.get(ROOT_VARIABLE)
    if key.rpartition(".")[2] in FOLDER_KEYS and data and Path(value).is_absolute():
        folder = Path(value).resolve()
        if folder.is_relative_to(Path(data).resolve()):
            return f"{key}=${ROOT_VARIABLE}/{shlex.quote(folder.relative_to(Path(data).resolve()).as_posix())}"
    return shlex.quote(f"{key}={value}")


def main(arguments: Sequence[str]) -> None:
    """Add the rows of runs to a file, or print them; runs without scores are listed, with why."""
    out = next((Path(each.removeprefix("out=")) for each in arguments if each.startswith("out=")), None)
    runs, left_out = read_runs([Path(each) for each in arguments if not each.startswith("out=")])
    for why in left_out:
        print(f"left out: {why}", file=sys.stderr)
    text = evidence(runs, out)
    write_text(out, text) if out else print(text, end="")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except CTMError as error:
        sys.exit(f"error: {error}")
