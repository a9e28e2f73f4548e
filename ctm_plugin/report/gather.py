"""Runs into cells: means over seeds and scenes, the paper's values, and paired differences."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from scipy.stats import t as student

from ctm_plugin.errors import CTMError
from ctm_plugin.metrics.summary import no_measurement
from ctm_plugin.metrics.table import METRICS
from ctm_plugin.report.apart import BASE, differing, keys_of, names
from ctm_plugin.report.paper import PaperTable, Row, datasets, paper_table, per_scene
from ctm_plugin.report.runs import BACKGROUNDS, Run, Setting

CONFIDENCE = 0.95
LAYOUTS = {"RawNeRF": "rawnerf", "Synthetic-NeRF": "blender", "Low-Texture-Blender": "llff"}
"""Of the paper's data sets."""

Rows = Sequence[tuple[str, list[Run]]]
"""Labels, and the runs of each."""


@dataclass(frozen=True)
class Cell:
    """One setting's score.

    Attributes:
        mean: over scenes of the means over seeds, of all runs, converged or not; ``None``: no run has it, or none
            converged.
        std: standard deviation over seeds of the mean over scenes, of two or more seeds.
        seeds: how many all scenes have.
        scenes, expected: how many it is of, and how many there are.
        not_converged, runs: how many; as in paired differences, those that did not converge count.
        paper: the paper's value; ``math.nan``: N.C. there, ``None``: the paper has none.
        rank: 1 for the best of a column, 2 for the second best, else 0.
    """

    mean: float | None = None
    std: float | None = None
    seeds: int = 0
    scenes: int = 0
    expected: int = 1
    not_converged: int = 0
    runs: int = 0
    paper: float | None = None
    rank: int = 0

    @property
    def difference(self) -> float | None:
        return None if self.mean is None or self.paper is None or math.isnan(self.paper) else self.mean - self.paper


@dataclass(frozen=True)
class Column:
    """A metric, over all scenes or on one of them."""

    label: str
    metric: str
    scene: str | None = None
    net: str | None = None
    """LPIPS' network, where runs have several: what another one says is another measure."""


@dataclass(frozen=True)
class Comparison:
    """A row against another, run by run of the same scene and seed.

    Attributes:
        label: of both rows.
        mean: of the differences.
        half: half the width of their 95 % confidence interval (Student's t, all pairs alike); of two or more pairs.
        pairs: how many.
        better: ``True`` or ``False`` where the interval leaves 0 out, else ``None``.
    """

    label: str
    column: Column
    mean: float
    half: float | None
    pairs: int
    better: bool | None

    @property
    def metric(self) -> str:
        return self.column.metric


@dataclass
class Gathered:
    """A table of runs, ready to be written in any format.

    Attributes:
        data: what the paper's values were measured on; empty: the table has none, and a cell's ``paper`` is
            what others published, in a row of their own.
    """

    title: str
    data: str
    columns: list[Column]
    labels: list[str]
    cells: list[list[Cell]]
    comparisons: list[Comparison] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def gather(table: PaperTable, runs: Sequence[Run]) -> Gathered:
    """A table of the paper out of those runs that belong in it.

    Raises:
        CTMError: none does.
    """
    rows = by_row(table, runs)
    used = [run for _, members in rows for run in members]
    if not used:
        raise CTMError(f"table {table.number}: found none of its rows among {len(runs)} runs, expected some")
    if table.by_scene:
        (metric,) = table.metrics
        columns = [Column(scene, metric, scene) for scene in sorted({run.scene for run in used})]
        columns.append(Column("mean", metric))
    else:
        columns = columns_of(table.metrics, used)
    all_scenes = len({run.scene for run in used})
    lines = [[cell_of(members, column, 1 if column.scene else all_scenes) for column in columns] for _, members in rows]
    set_ranks(lines, columns)
    if table.data:
        for (row, members), line in zip(rows, lines, strict=True):
            line[:] = [replace(c, paper=_papers(row, at, table, members)) for c, at in zip(line, columns, strict=True)]
    found = Gathered(f"Table {table.number}: {table.title}", table.data, columns, [row.label for row, _ in rows], lines)
    found.comparisons = _comparisons(table, rows, [column for column in columns if not column.scene])
    others = len(runs) - len({run.folder for run in used})
    found.notes = notes_of(used) + ([f"In no row of this table: {others} of the runs."] if others else [])
    return found


def data_of(run: Run) -> str | None:
    """The paper's data set that a run is of, by its layout and its scene's name; ``None``: of none."""
    dataset = run.config["dataset"]
    for table in per_scene().values():
        names = {name for row in table.rows for name in row.paper} - {"*"}
        if dataset["name"] == LAYOUTS.get(table.data) and _paper_scene(run.scene, names):
            if dataset["name"] != "blender":
                return table.data
            dimmed = dataset.get("exposure", 1) != 1
            return None if dimmed else f"{table.data}-Dark" if "dark" in run.scene.lower() else table.data
    return None


def with_papers(table: PaperTable, runs: Sequence[Run]) -> PaperTable:
    """The table for runs: with the paper's values if all runs are of its data set (Table 1 of it); else without."""
    data, *others = {data_of(run) for run in runs} or {None}
    if data and not others and data in datasets(table.number):
        return paper_table(table.number, data)
    return replace(table, data="")


def by_row(table: PaperTable, runs: Sequence[Run]) -> list[tuple[Row, list[Run]]]:
    """The rows that have runs, with these; rows of its own for each backbone, preset and what else sets runs apart."""
    used = [run.setting for run in runs if any(row.fits(run.setting) for row in table.rows)]
    backbones, presets = sorted({s.backbone for s in used}), sorted({s.ctm for s in used} - {"off"})
    apart = sorted({s.others for s in used})
    rows = []
    for backbone, row, preset, others in itertools.product(backbones, table.rows, ("off", *presets), apart):
        kind = (backbone, preset, others)
        these = [r for r in runs if row.fits(s := r.setting) and (s.backbone, s.ctm, s.others) == kind]
        if these:
            said = [backbone] if len(backbones) > 1 and backbone not in row.label.lower() else []
            said += [preset] if preset != "off" and len(presets) > 1 and f"ctm={preset}" not in row.label else []
            said += [f"{key}={value}" for key, value in others]
            label = f"{row.label} ({', '.join(said)})" if said else row.label
            rows.append((replace(row, label=label, name=row.label), these))
    return rows


def configurations(runs: Sequence[Run]) -> Rows:
    """Runs of each setting, named by what differs between them."""
    found: dict[Setting, list[Run]] = {}
    for run in runs:
        found.setdefault(run.setting, []).append(run)
    labels = names(found)
    return [(labels[setting], found[setting]) for setting in sorted(found, key=_order)]


def _order(setting: Setting) -> list[tuple]:
    """RGB without CTM first; numbers by their size."""
    keys = keys_of(setting)
    others = [keys[key] != value for key, value in ({"ctm": "off"} | BASE).items()]
    return [_sortable(value) for value in (keys["backbone"], *others, *keys.values())]


def _sortable(value: Any) -> tuple[float, str]:
    try:
        return float(value), ""
    except (TypeError, ValueError):
        return math.inf, str(value)


def columns_of(metrics: Iterable[str], runs: Sequence[Run]) -> list[Column]:
    """A column for each metric, of LPIPS one for each network where runs have several."""
    nets = sorted({run.metrics["lpips_net"] for run in runs if run.metrics.get("lpips_net")})
    return [
        Column(f"{METRICS[metric].label} ({net})" if net else METRICS[metric].label, metric, net=net)
        for metric in metrics
        for net in (nets if len(nets) > 1 and metric.startswith("lpips") else [None])
    ]


def by_scene(rows: Rows) -> list[tuple[str, Rows]]:
    """Rows of each scene, and for each backbone with several scenes those that have all, for the mean over them."""
    blocks = []
    for scene in sorted({run.scene for _, members in rows for run in members}):
        own = [(label, [run for run in members if run.scene == scene]) for label, members in rows]
        blocks.append((scene, [row for row in own if row[1]]))
    for backbone in sorted({members[0].setting.backbone for _, members in rows}):
        own = [(row, {run.scene for run in row[1]}) for row in rows if row[1][0].setting.backbone == backbone]
        scenes = set().union(*(of_row for _, of_row in own))
        everywhere = [row for row, of_row in own if of_row == scenes]
        if len(scenes) > 1 and everywhere:
            blocks.append((f"mean of {len(scenes)} scenes", everywhere))
    return blocks


def cell_of(runs: Sequence[Run], column: Column, expected: int = 1) -> Cell:
    """A row's scores in a column, of ``expected`` scenes."""
    these = [run for run in runs if column.scene in (None, run.scene)]
    scored: dict[str, dict[int, float]] = {}
    for run in these:
        if (value := score(run, column)) is not None:
            scored.setdefault(run.scene, {})[run.seed] = value
    # The clock's and the photographs' own.
    sound = column.metric.endswith("_photo") or (column.metric in METRICS and not METRICS[column.metric].of)
    if not sound and not any(run.converged for run in these):
        scored = {}
    seeds = {seed for of_scene in scored.values() for seed in of_scene}
    common = [seed for seed in sorted(seeds) if all(seed in of_scene for of_scene in scored.values())]
    by_seed = [statistics.fmean(of_scene[seed] for of_scene in scored.values()) for seed in common]
    return Cell(
        mean=statistics.fmean(statistics.fmean(each.values()) for each in scored.values()) if scored else None,
        std=statistics.stdev(by_seed) if len(by_seed) > 1 else None,
        seeds=len(common),
        scenes=len(scored),
        expected=expected,
        not_converged=0 if sound else sum(not run.converged for run in these),
        runs=len(these),
    )


def score(run: Run, column: Column) -> float | None:
    """A run's value in a column."""
    return run.value(column.metric) if column.net in (None, run.metrics.get("lpips_net")) else None


def _papers(row: Row, column: Column, table: PaperTable, runs: Sequence[Run]) -> float | None:
    """The paper's value; of a table of scenes, that of the scene, or the mean over the scenes that are here."""
    if not table.by_scene:
        value = row.paper.get(column.metric)
        return math.nan if value is None and column.metric in row.paper else value
    if "*" in row.paper:
        return math.nan
    scenes = {run.scene for run in runs if score(run, column) is not None} or {run.scene for run in runs}
    wanted = [_paper_scene(scene, row.paper) for scene in ([column.scene] if column.scene else sorted(scenes))]
    values = [row.paper[name] for name in wanted if name]
    return statistics.fmean(values) if values and len(values) == len(wanted) else None


def _paper_scene(scene: str, known: Collection[str]) -> str | None:
    """The paper's name in a scene's: ``lego`` in ``lego_400``; the longest one."""
    names = [name for name in known if name in scene.lower()]
    return max(names, key=len) if names else None


def set_ranks(lines: Sequence[list[Cell]], columns: Sequence[Column]) -> None:
    """Rank the cells of some lines among each other, column by column; a cell that lacks a scene is not ranked."""
    for index, column in enumerate(columns):
        means = [None if line[index].scenes < line[index].expected else line[index].mean for line in lines]
        values = sorted({mean for mean in means if mean is not None}, reverse=METRICS[column.metric].higher)
        places = {value: place for place, value in enumerate(values[:2], start=1)} if len(values) > 1 else {}
        for line, mean in zip(lines, means, strict=True):
            line[index] = replace(line[index], rank=places.get(mean, 0))


def _comparisons(
    table: PaperTable, rows: Sequence[tuple[Row, list[Run]]], columns: Sequence[Column]
) -> list[Comparison]:
    found = []
    for row, members in rows:
        against = row.against or table.reference
        setting = members[0].setting
        others = [
            (other, those)
            for other, those in rows
            if other.name == against
            and those[0].setting.ctm in ("off", setting.ctm)
            and not differing(setting, those[0].setting) & {key for key, _ in setting.others}
            and (setting.backbone == those[0].setting.backbone or table.number == 1)
        ]
        for other, those in others[:1]:
            if those is not members:
                found += compare(f"{row.label} - {other.label}", columns, members, those)
    return found


def compare(label: str, columns: Iterable[Column], runs: Sequence[Run], reference: Sequence[Run]) -> list[Comparison]:
    """Paired differences ``runs - reference`` in each column, over scenes and seeds that both have."""
    found = []
    for column in columns:
        theirs = {(run.scene, run.seed): score(run, column) for run in reference}
        pairs = [
            value - other
            for run in runs
            if (value := score(run, column)) is not None and (other := theirs.get((run.scene, run.seed))) is not None
        ]
        if not pairs:
            continue
        mean, half, better = statistics.fmean(pairs), None, None
        if len(pairs) > 1:
            factor = float(student.ppf(0.5 + CONFIDENCE / 2, len(pairs) - 1))
            half = factor * statistics.stdev(pairs) / len(pairs) ** 0.5
            if abs(mean) > half:
                better = (mean > 0) == METRICS[column.metric].higher
        found.append(Comparison(label, column, mean, half, len(pairs), better))
    return found


def backgrounds_of(runs: Sequence[Run]) -> list[str]:
    """A note on each scene whose runs were trained before random backgrounds of several levels."""
    levels: dict[str, dict[str, set[str]]] = {}
    for run in runs:
        if run.rest["dataset"].get("background") not in ("random", "random_matched"):
            continue
        by_ctm = levels.setdefault(run.scene, {})
        by_ctm.setdefault(f"ctm={run.setting.ctm}", set()).add(str(run.level))
    return [
        f"{scene}: {BACKGROUNDS} is "
        + ", ".join(f"{' and '.join(sorted(those))} for {ctm}" for ctm, those in sorted(by_ctm.items()))
        + "."
        for scene, by_ctm in sorted(levels.items())
        if len(set().union(*by_ctm.values())) > 1
    ]


def notes_of(runs: Sequence[Run]) -> list[str]:
    """How runs were scored and trained, and where their scores are none."""
    notes = [f"Protocol: {protocol}." for protocol in sorted({run.metrics["protocol"] for run in runs})]
    budgets = sorted({f"{run.setting.backbone} {run.metrics['steps']} steps" for run in runs})
    if not any(run.measured for run in runs):
        steps = sorted({run.metrics["steps"] for run in runs})
        notes.insert(0, f"{no_measurement(' and '.join(map(str, steps)))}.")
    elif not any(run.converged for run in runs):
        notes.insert(0, "No run converged: none is 1 dB better than the best constant colour.")
    return [*notes, f"Budget: {', '.join(budgets)}.", *backgrounds_of(runs)]
