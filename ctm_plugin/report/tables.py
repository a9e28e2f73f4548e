"""The tables of a report: all runs, views in normal light, and the paper's, which ``tables.yaml`` holds."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.resources import files
from typing import Any

import yaml

from ctm_plugin.errors import CTMError
from ctm_plugin.metrics.evaluate import is_measurement, no_measurement
from ctm_plugin.metrics.table import METRICS, told_at
from ctm_plugin.report.cells import Cell, Column, Rows, Table, cell_of, columns_of
from ctm_plugin.report.labels import BACKGROUNDS, UNNAMED_VALUES, Found, differing, grouped, most_have, others
from ctm_plugin.report.runs import Run, Setting, weights

DATA: dict[str, Any] = yaml.load((files(__package__) / "tables.yaml").read_text(encoding="utf-8"), yaml.BaseLoader)
"""Contents of ``tables.yaml``."""
PAPER: dict[int, dict[str, Any]] = {int(number): DATA["methods"] | table for number, table in DATA["tables"].items()}
"""The paper's tables by their number."""
LIT_TABLE = DATA["lit"]
"""Published scores of lit views."""
NO_CTM = {"ctm": "off"} | UNNAMED_VALUES
"""Setting of the row that others are compared with, where it has runs: plain RGB without CTM."""
Named = Iterator[tuple[str, list[Run]]]


def choose(group: Found, number: int | None, data: str | None) -> list[Table]:
    """Make the paper's table of a ``number``; else tables of all runs, of lit views, and of the paper.

    Of the paper's Tables 1 to 7 those with runs on the paper's data sets are made. A table is left out if only one of
    its settings has runs, or if another table has all of its settings.
    """
    if data is not None or number is not None:
        return [paper_table(number or 1, data, group.runs)]
    tables = [all_runs(group)]
    if lit := [run for run in group.runs if run.value("psnr_lit") is not None]:
        tables.append(lit_views(lit))
    for name, own in sorted(grouped(group.runs, lambda run: data_of(run) or "").items()):
        possible = [number for number in range(1, 8) if name in datasets(number)]
        filled = [{run.key for *_, runs in by_row(PAPER[number], own) for run in runs} for number in possible]
        for index, (number, settings) in enumerate(zip(possible, filled, strict=True)):
            within = (settings < other or (settings == other and i < index) for i, other in enumerate(filled))
            if len(settings) > 1 and not any(within):
                tables.append(paper_table(number, name, own))
    return tables


# All runs


def all_runs(group: Found) -> Table:
    """A row for each setting on each scene, and on the mean over a backbone's scenes.

    Below, paired differences between settings that differ in one key. Where closed forms were swept, also the
    difference from the closed form that scores best on each scene, for each metric its own. It is chosen by the
    scores that are compared, so that no single closed form can be above it.
    """
    runs, rows = group.runs, configurations(group.runs)
    columns = columns_of((name for name in told_at("report") if any(run.value(name) is not None for run in runs)), runs)
    table = Table("All runs", columns, notes=[*notes_of(runs), *group.shared])
    if common := most_have([members[0].setting for _, members in rows]):
        table.notes.append(f"In all rows without other values: {' '.join(f'{k}={v}' for k, v in common.items())}.")
    # Runs of experiment=colors: some have only a fixed space that is in no table of the paper.
    known = {row.get("color_space", "rgb") for row in PAPER[2]["rows"].values()}
    closed = any(run.setting["ctm"] == "off" and run.setting["color_space"] not in known for run in runs)
    blocks = blocks_of(rows)
    for name, own in blocks:
        table.add(own, f"{name}: " if len(blocks) > 1 else "", references=partial(_compared, own, closed))
    if len(blocks) == 1:
        table.title += f": {blocks[0][0]}"
    return table


def configurations(runs: Sequence[Run]) -> Rows:
    """Rows of a table: the runs of each setting, by label; RGB without CTM first, numbers in ascending order."""

    def order(runs: list[Run]) -> list[tuple]:
        keys = runs[0].setting
        return [
            _sortable(value) for value in (keys["backbone"], *(keys[k] != v for k, v in NO_CTM.items()), *keys.values())
        ]

    return [(members[0].label, members) for members in sorted(grouped(runs, lambda run: run.key).values(), key=order)]


def _sortable(value: Any) -> tuple[float, str]:
    try:
        return float(value), ""
    except (TypeError, ValueError):
        return math.inf, str(value)


def by_scene(rows: Rows) -> dict[str, Rows]:
    """Split rows by scene: the rows of each scene, with only its runs."""
    groups: dict[str, Rows] = {}
    for label, members in rows:
        for scene, own in grouped(members, lambda run: run.scene).items():
            groups.setdefault(scene, []).append((label, own))
    return dict(sorted(groups.items()))


def blocks_of(rows: Rows) -> list[tuple[str, Rows]]:
    """Blocks of a table: rows of each scene; for each backbone with several scenes, the means of rows that have all."""
    blocks = list(by_scene(rows).items())
    for backbone in sorted({members[0].setting["backbone"] for _, members in rows}):
        own = [row for row in rows if row[1][0].setting["backbone"] == backbone]
        scenes = by_scene(own)
        everywhere = [row for row in own if len(by_scene([row])) == len(scenes)]
        if len(scenes) > 1 and everywhere:
            blocks.append((f"mean of {len(scenes)} scenes", everywhere))
    return blocks


def _compared(rows: Rows, closed: bool, runs: list[Run], column: Column) -> Named:
    """Reference rows of a row's runs: rows that differ from it in one key and have that key's reference value.

    That is no CTM, RGB and the like; of other keys the commonest value, the first of several. With ``closed``, also the
    best closed form; on a single scene that is one of the rows.
    """
    if not METRICS[column.metric].of:
        return
    setting, settings = runs[0].setting, [members[0].setting for _, members in rows]
    apart = [differing(setting, other) for other in settings]
    for key in sorted(setting):
        values = [other.get(key) for other in settings]
        counts = Counter(values)
        there = [value for value, keys in zip(values, apart, strict=True) if keys == {key}] + [setting[key]]
        best = min(there, key=lambda value: (value != NO_CTM.get(key), -counts[value], values.index(value)))
        if best != setting[key]:
            yield from (row for row, keys, v in zip(rows, apart, values, strict=True) if keys == {key} and v == best)
    if closed and (len({run.scene for run in runs}) > 1 or setting["ctm"] != "off"):
        yield _best_closed_form(rows, setting, column)


def _best_closed_form(rows: Rows, setting: Setting, column: Column) -> tuple[str, list[Run]]:
    """Choose for each scene the runs of the fixed colour space that is best in a column, among those of most seeds."""
    forms = [
        run
        for _, members in rows
        for run in members
        if (other := run.setting)["ctm"] == "off" and other["color_space"] != "rgb"
        and differing(setting, other) <= {"ctm", "color_space"} and column.score(run) is not None
    ]  # fmt: skip

    def worth(runs: Sequence[Run]) -> tuple[int, float]:
        return len(runs), (1 if METRICS[column.metric].higher else -1) * statistics.fmean(map(column.score, runs))

    of_scenes = grouped(forms, lambda run: run.scene).values()
    best = [max(grouped(of_scene, lambda run: run.key).values(), key=worth) for of_scene in of_scenes]
    spaces = sorted({runs[0].setting["color_space"].partition(" ")[0] for runs in best})
    return f"best closed form ({', '.join(spaces)})", [run for runs in best for run in runs]


# Views in normal light


def lit_views(runs: Sequence[Run]) -> Table:
    """Scores of lit views, scene by scene and on the mean.

    Each scene has a row a setting; the dark photographs of the test views in the same light, a yardstick; each
    setting with the colour map that was fitted to the references, an oracle; and of LOM's scenes the published values.
    """
    low = [run for run in runs if {"dark": "low", "lit": "high"}.items() <= run.config["dataset"].items()]
    lom = {run.scene for run in low} & LIT_TABLE["values"].keys()
    fitted = ["psnr_fitted"] * any(run.setting["appearance"] != "none" for run in runs)
    columns = columns_of([*LIT_TABLE["metrics"], "psnr", *fitted], runs, [LIT_TABLE["net"]] * bool(lom))
    table = Table(
        "Lit views", columns, notes=[LIT_TABLE["note"], *[LIT_TABLE["published"]] * bool(lom), *notes_of(runs)]
    )

    def of(which: str, runs: Sequence[Run]) -> list[Cell]:
        """Cells of the columns' metrics with the suffix ``which``, as ``psnr_lit_photo``; empty for other metrics."""
        metrics = [column.metric + which if column.metric in LIT_TABLE["metrics"] else "" for column in columns]
        return [cell_of(runs, replace(each, metric=metric)) for each, metric in zip(columns, metrics, strict=True)]

    def published(name: str) -> Iterator[tuple[str, list[Cell]]]:
        for method, values in LIT_TABLE["values"][name].items():
            known = dict(zip(LIT_TABLE["metrics"], map(float, values), strict=True))
            theirs = [known.get(each.metric) if each.net in (None, LIT_TABLE["net"]) else None for each in columns]
            yield f"{name}: {method}, as published", [Cell(paper=value) for value in theirs]

    for name, rows in blocks_of(configurations(runs)):
        table.add(rows, f"{name}: ")
        photographs = {run.scene: run for run in rows[0][1]}  # the same for all without an appearance, which come first
        label = f"{name}: the dark photographs themselves, lit"
        table.rows.append((label, of("_photo", list(photographs.values()))))
        for label, members in rows:
            oracle = f"{name}: {label}, colours fitted to the references (an oracle)"
            table.rows.append((oracle, of("_fitted", members)))
        table.rows += published(name) if name in lom else []
    table.rows += published(LIT_TABLE["mean"]) if lom else []
    return table


# The paper's


def paper_table(number: int, data: str | None, runs: Sequence[Run]) -> Table:
    """Make a table of the paper out of the runs that belong in it, with the paper's values for a data set.

    Without ``data``, the runs' data set is taken; a table without values for it has none.

    Raises:
        CTMError: there is no such table, it has no values for that data set, or no run belongs in it.
    """
    if number not in PAPER:
        raise CTMError(f"table: found {number}, expected one of {', '.join(map(str, PAPER))}")
    if data is not None and data not in datasets(number):
        raise CTMError(f"data: found {data!r}, expected, with table={number}, one of {', '.join(datasets(number))}")
    given = PAPER[number]
    rows = by_row(given, runs)
    used = [run for *_, members in rows for run in members]
    if not used:
        raise CTMError(f"table {number}: found none of its rows among {len(runs)} runs, expected some")
    wanted = {data} if data is not None else {data_of(run) for run in used}
    name = next((name for name in given["values"] if wanted == {name.partition(",")[0]}), "")
    scenes = sorted({run.scene for run in used})
    columns = columns_of(given["metrics"], used)
    if "title" not in given:  # by scene
        (metric,) = given["metrics"]
        columns = [*(Column(scene, metric, scene) for scene in scenes), Column("mean", metric)]
    table = Table(f"Table {number}: {given.get('title') or given['metrics'][0].upper() + ' by scene'}", columns, name)
    table.add([row[1:] for row in rows], "", len(scenes), partial(_references, number, rows))
    for (row, _, members), (_, cells) in zip(rows, table.rows, strict=True):
        for cell, column in zip(cells, columns, strict=True):
            cell.paper = _paper_value(given["values"][name][row], given["metrics"], column, members) if name else None
    others = len(runs) - len({run.folder for run in used})
    table.notes = notes_of(used) + [f"In no row of this table: {others} of the runs."] * bool(others)
    return table


def datasets(number: int) -> list[str]:
    """Data sets that a table of the paper has values for; Table 1 has four."""
    return [name.partition(",")[0] for name in PAPER[number]["values"]]


def data_of(run: Run) -> str | None:
    """Find the paper's data set that a run was trained on, by layout and scene name; ``None``: another data set."""
    dataset = run.config["dataset"]
    for name, layout in DATA["layouts"].items():
        scenes = next(each["values"][name]["DVGO"] for n, each in PAPER.items() if n > 7 and name in each["values"])
        if dataset["name"] == layout and _scene_in(run.scene, scenes):
            if layout != "blender":
                return name
            dimmed = dataset.get("exposure", 1) != 1
            return None if dimmed else f"{name}-Dark" if "dark" in run.scene.lower() else name
    return None


def _scene_in(scene: str, known: Collection[str]) -> str | None:
    """Find the paper's scene name in a run's: ``lego`` in ``lego_400``; of several the longest."""
    return max((name for name in known if name in scene.lower()), key=len, default=None)


def fits(setting: Setting, row: Mapping[str, str]) -> bool:
    """Whether a setting belongs in a row of the paper: keys that the row does not name have the paper's values."""
    learned = row.get("ctm") != "off"
    wanted = DATA["usual"] | (DATA["learned"] if learned else {}) | row
    return (
        (setting["ctm"] != "off") == learned
        and [k for k, v in weights(setting).items() if v == "0"] == list(weights(row))
        and all((setting.get(k) or "null") == v for k, v in wanted.items() if k not in {"ctm", *weights(row)})
    )


def by_row(table: Mapping[str, Any], runs: Sequence[Run]) -> list[tuple[str, str, list[Run]]]:
    """Rows of a paper's table that have runs, as (name, label, runs); one for each backbone, preset and other key."""
    kinds: dict[tuple, list[Run]] = {}
    for index, (name, row) in enumerate(table["rows"].items()):
        for run in runs:
            if fits(s := run.setting, row):
                kinds.setdefault((s["backbone"], index, s["ctm"], tuple(others(s).items()), name), []).append(run)
    backbones, presets = {kind[0] for kind in kinds}, {kind[2] for kind in kinds} - {"off"}

    def label(backbone: str, _: int, preset: str, apart: tuple, name: str) -> str:
        extras = [backbone] if len(backbones) > 1 and backbone not in name.lower() else []
        extras += [preset] if preset != "off" and len(presets) > 1 else []
        extras += [f"{key}={value}" for key, value in apart]
        return f"{name} ({', '.join(extras)})" if extras else name

    return [(kind[-1], label(*kind), kinds[kind]) for kind in sorted(kinds)]


def _references(number: int, rows: Sequence[tuple[str, str, list[Run]]], runs: list[Run], column: Column) -> Named:
    """Reference row of a paper's row: the same backbone and preset without CTM, or the table's reference."""
    if column.scene:
        return
    table, setting = PAPER[number], runs[0].setting
    row = next(row for row, _, members in rows if members is runs)
    without = row.removesuffix(" w/ CTM")
    against = without if without != row and without in table["rows"] else table["against"]
    against = table.get("compared", {}).get(row, against)
    for name, label, peers in rows:
        other = peers[0].setting
        if (
            name == against
            and other["ctm"] in ("off", setting["ctm"])
            and not differing(setting, other) & others(setting).keys()
            and (setting["backbone"] == other["backbone"] or number == 1)
        ):
            if peers is not runs:
                yield label, peers
            return


def _paper_value(values: Any, metrics: Sequence[str], column: Column, runs: Sequence[Run]) -> float | None:
    """The paper's value of a row in a column; in a table by scene, the scene's, or the mean over the runs' scenes."""
    if isinstance(values, str):  # N.C.
        return math.nan
    if isinstance(values, list):
        return {metric: float(value) for metric, value in zip(metrics, values, strict=False)}.get(column.metric)
    scenes = {run.scene for run in runs if column.score(run) is not None} or {run.scene for run in runs}
    wanted = [_scene_in(scene, values) for scene in ([column.scene] if column.scene else sorted(scenes))]
    return statistics.fmean(float(values[name]) for name in wanted) if all(wanted) else None


# Notes


def notes_of(runs: Sequence[Run]) -> list[str]:
    """Notes under a table: how runs were scored and trained, and which scores are missing."""
    notes = [f"Protocol: {protocol}." for protocol in sorted({run.metrics["protocol"] for run in runs})]
    budgets = sorted({f"{run.setting['backbone']} {run.metrics['steps']} steps" for run in runs})
    # Runs of old versions do not say whether they were.
    if not any(run.metrics.get("measured", is_measurement(run.config)) is not False for run in runs):
        steps = sorted({run.metrics["steps"] for run in runs})
        notes.insert(0, f"{no_measurement(' and '.join(map(str, steps)))}.")
    elif not any(run.converged for run in runs):
        notes.insert(0, "No run converged: none is 1 dB better than the best constant colour.")
    notes.append(f"Budget: {', '.join(budgets)}.")
    random = [run for run in runs if run.rest.get("dataset.background") in ("random", "random_matched")]
    for scene, members in sorted(grouped(random, lambda run: run.scene).items()):
        by_ctm = sorted(grouped(members, lambda run: run.setting["ctm"]).items())
        levels = {ctm: sorted({run.rest[BACKGROUNDS] for run in of_ctm}) for ctm, of_ctm in by_ctm}
        if len(set().union(*levels.values())) > 1:
            levels_by_ctm = (f"{' and '.join(each)} for ctm={ctm}" for ctm, each in levels.items())
            notes.append(f"{scene}: {BACKGROUNDS} is {', '.join(levels_by_ctm)}.")
    return notes
