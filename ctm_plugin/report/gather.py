"""Runs into cells: means over seeds and scenes beside the paper's values, and paired differences."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

from scipy.stats import t as student

from ctm_plugin.errors import CTMError
from ctm_plugin.metrics.table import METRICS, told_at
from ctm_plugin.report.alike import agree, check_alike
from ctm_plugin.report.paper import PaperTable, Row, per_scene
from ctm_plugin.report.runs import BACKGROUNDS, Run, Setting, has_appearances

CONFIDENCE = 0.95
SHIPPED = ("still_life", "white_room", "planar")
"""Data sets that are the package's, whose names say so."""
PAPERS = ("blender", "llff", "rawnerf")
"""Layouts of the paper's scenes."""


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
    metric: str
    mean: float
    half: float | None
    pairs: int
    better: bool | None


@dataclass(frozen=True)
class Column:
    """A metric, over all scenes or on one of them."""

    label: str
    metric: str
    scene: str | None = None


@dataclass
class Gathered:
    """A table of runs, ready to be written in any format.

    Attributes:
        data: what the paper's values were measured on; empty: there are none beside ours, and a cell's ``paper`` is
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
        CTMError: none does, or some differ in what no table varies.
    """
    rows = by_row(table, runs)
    used = [run for _, members in rows for run in members]
    for row, members in rows:
        check_single(row, members)
    if not used:
        raise CTMError(f"table {table.number}: found none of its rows among {len(runs)} runs, expected some")
    check_alike(used)
    columns = _columns(table, used)
    all_scenes = len({run.scene for run in used})
    lines = [[cell_of(row, members, column, table) for column in columns] for row, members in rows]
    for index, column in enumerate(columns):
        expected = 1 if column.scene else all_scenes
        # Rows that lack a scene are not compared with those that have all.
        means = [line[index].mean if line[index].scenes == expected else None for line in lines]
        for line, rank in zip(lines, ranks(means, column.metric), strict=True):
            line[index] = replace(line[index], rank=rank, expected=expected)
    title = f"Table {table.number}: {table.title}" if table.number else table.title.capitalize()
    found = Gathered(title, table.data, columns, [row.label for row, _ in rows], lines)
    found.comparisons = _comparisons(table, rows)
    found.notes = _notes(used, len(runs) - len({run.folder for run in used}))
    return found


def without_papers(table: PaperTable, runs: Sequence[Run]) -> PaperTable:
    """The table; without the paper's values where a run is of a scene that neither the paper nor the package has."""
    scenes = {name for each in per_scene().values() for row in each.rows for name in row.paper} - {"*"}

    def is_known(run: Run) -> bool:
        layout = run.config["dataset"]["name"]
        return layout in SHIPPED or (layout in PAPERS and _paper_scene(run.scene, scenes) is not None)

    return table if all(map(is_known, runs)) else replace(table, data="")


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


def describe(setting: Setting) -> str:
    """A setting in words: what is not the paper's own choice."""
    own = {"color_space": ("rgb",), "loss": ("mse",), "encoding": (None,), "P": (None, 4), "k": (None, 3)}
    own |= {"appearance": ("none",)}
    said = [f"{key}={getattr(setting, key)}" for key, values in own.items() if getattr(setting, key) not in values]
    without = [f"without {term}" for term in sorted(setting.without)]
    return " ".join([setting.backbone, f"ctm={setting.ctm}", *said, *without])


def all_settings(runs: Sequence[Run]) -> PaperTable:
    """A table with a row for each setting that the runs have."""
    settings = sorted({run.setting for run in runs}, key=lambda s: (s.backbone, s.ctm != "off", describe(s), s.others))
    rows = tuple(Row(describe(setting), lambda other, own=setting: other == own) for setting in settings)
    shown = [*told_at("report"), *["psnr_fitted"] * has_appearances(runs)]
    metrics = tuple(name for name in shown if any(run.value(name) is not None for run in runs))
    of_patches = tuple(name for name in metrics if METRICS[name].of == ("patches",))
    metrics = of_patches or metrics
    return PaperTable(0, "all runs", "", rows, metrics, rows[0].label)


def check_single(row: Row, runs: Sequence[Run]) -> None:
    """Refuse a second run of a row on one scene with one seed.

    Raises:
        CTMError: there is one; both are named.
    """
    first: dict[tuple[str, int], Run] = {}
    for run in runs:
        other = first.setdefault((run.scene, run.seed), run)
        if other is not run:
            raise CTMError(
                f"{run.folder}: found a second run of {row.label} on {run.scene} with seed {run.seed}, expected one: "
                f"the other is {other.folder}"
            )


def _columns(table: PaperTable, runs: Sequence[Run]) -> list[Column]:
    if not table.by_scene:
        return [Column(METRICS[metric].label, metric) for metric in table.metrics]
    (metric,) = table.metrics
    return [*(Column(scene, metric, scene) for scene in sorted({run.scene for run in runs})), Column("mean", metric)]


def cell_of(row: Row, runs: Sequence[Run], column: Column, table: PaperTable | None = None) -> Cell:
    """A row's scores in a column, and the paper's value where the table has such."""
    these = [run for run in runs if column.scene in (None, run.scene)]
    scored: dict[str, dict[int, float]] = {}
    for run in these:
        value = run.value(column.metric)
        if value is not None:
            scored.setdefault(run.scene, {})[run.seed] = value
    if not any(run.converged for run in these):
        scored = {}
    seeds = {seed for of_scene in scored.values() for seed in of_scene}
    common = [seed for seed in sorted(seeds) if all(seed in of_scene for of_scene in scored.values())]
    by_seed = [statistics.fmean(of_scene[seed] for of_scene in scored.values()) for seed in common]
    papers = _papers(row, column, table, set(scored) or {run.scene for run in these}) if table and table.data else None
    return Cell(
        mean=statistics.fmean(statistics.fmean(each.values()) for each in scored.values()) if scored else None,
        std=statistics.stdev(by_seed) if len(by_seed) > 1 else None,
        seeds=len(common),
        scenes=len(scored),
        not_converged=sum(not run.converged for run in these),
        runs=len(these),
        paper=papers,
    )


def _papers(row: Row, column: Column, table: PaperTable, scenes: set[str]) -> float | None:
    """The paper's value; of a table of scenes, that of the scene, or the mean over the scenes that are here."""
    if not table.by_scene:
        value = row.paper.get(column.metric)
        return math.nan if value is None and column.metric in row.paper else value
    if "*" in row.paper:
        return math.nan
    wanted = [_paper_scene(scene, row.paper) for scene in ([column.scene] if column.scene else sorted(scenes))]
    values = [row.paper[name] for name in wanted if name]
    return statistics.fmean(values) if values and len(values) == len(wanted) else None


def _paper_scene(scene: str, known: Collection[str]) -> str | None:
    """The paper's name in a scene's: ``lego`` in ``lego_400``; the longest one."""
    names = [name for name in known if name in scene.lower()]
    return max(names, key=len) if names else None


def ranks(means: Sequence[float | None], metric: str) -> list[int]:
    """1 for the best, 2 for the second best, 0 for the others, and for all where there is one value."""
    values = sorted({mean for mean in means if mean is not None}, reverse=METRICS[metric].higher)
    places = {value: place for place, value in enumerate(values[:2], start=1)} if len(values) > 1 else {}
    return [places.get(mean, 0) for mean in means]


def set_ranks(lines: Sequence[list[Cell]], columns: Sequence[Column]) -> None:
    """Rank the cells of some lines among each other, column by column."""
    for index, column in enumerate(columns):
        for line, rank in zip(lines, ranks([line[index].mean for line in lines], column.metric), strict=True):
            line[index] = replace(line[index], rank=rank)


def _comparisons(table: PaperTable, rows: Sequence[tuple[Row, list[Run]]]) -> list[Comparison]:
    found = []
    for row, members in rows:
        against = row.against or table.reference
        setting = members[0].setting
        others = [
            (other, those)
            for other, those in rows
            if other.name == against
            and those[0].setting.ctm in ("off", setting.ctm)
            and agree(setting, those[0].setting)
            and (setting.backbone == those[0].setting.backbone or table.number in (0, 1))
        ]
        for other, those in others[:1]:
            if {run.folder for run in those} != {run.folder for run in members}:
                label = f"{row.label} - {other.label}"
                found += [each for metric in table.metrics if (each := compare(label, metric, members, those))]
    return found


def compare(label: str, metric: str, runs: Sequence[Run], reference: Sequence[Run]) -> Comparison | None:
    """Paired differences ``runs - reference`` over scenes and seeds that both have."""
    theirs = {(run.scene, run.seed): run.value(metric) for run in reference}
    pairs = [
        value - other
        for run in runs
        if (value := run.value(metric)) is not None and (other := theirs.get((run.scene, run.seed))) is not None
    ]
    if not pairs:
        return None
    mean, half, better = statistics.fmean(pairs), None, None
    if len(pairs) > 1:
        factor = float(student.ppf(0.5 + CONFIDENCE / 2, len(pairs) - 1))
        half = factor * statistics.stdev(pairs) / len(pairs) ** 0.5
        if abs(mean) > half:
            better = (mean > 0) == METRICS[metric].higher
    return Comparison(label, metric, mean, half, len(pairs), better)


def budget_of(runs: Sequence[Run]) -> str:
    """Steps by backbone, as a note."""
    budgets = sorted({f"{run.setting.backbone} {run.metrics['steps']} steps" for run in runs})
    return f"Budget: {', '.join(budgets)}."


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


def _notes(runs: Sequence[Run], others: int) -> list[str]:
    protocols = sorted({run.metrics["protocol"] for run in runs})
    notes = [*(f"Protocol: {protocol}." for protocol in protocols), budget_of(runs), *backgrounds_of(runs)]
    return notes + ([f"In no row of this table: {others} of the runs."] if others else [])
