"""Cells of tables out of runs: means over seeds and scenes, ranks, paired differences with intervals."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from scipy.stats import t as student

from ctm_plugin.metrics.table import METRICS
from ctm_plugin.report.runs import Run

CONFIDENCE = 0.95
"""Level of the confidence intervals."""
Rows = Sequence[tuple[str, list[Run]]]
"""Rows of a table: each row's label and its runs."""


@dataclass(frozen=True)
class Column:
    """A column of a table: a metric, over all scenes or on one."""

    label: str
    metric: str
    scene: str | None = None
    net: str | None = None
    """LPIPS' network, where runs have several: their scores are different measures."""

    def score(self, run: Run) -> float | None:
        return run.value(self.metric) if self.net in (None, run.metrics.get("lpips_net")) else None


class Difference(NamedTuple):
    """Mean difference between two rows' runs, paired by scene and seed."""

    against: str
    """Label of the row that is subtracted."""
    mean: float
    half: float | None
    """Half the width of the 95 % confidence interval (Student's t over pairs), for two or more pairs."""
    pairs: int
    better: bool | None
    """Whether the difference is an improvement, where the interval excludes 0."""


@dataclass
class Cell:
    """A table's cell: the score of one row in one column."""

    mean: float | None = None
    """Mean over scenes of the means over seeds, converged or not; ``None``: no run has it, or none converged."""
    std: float | None = None
    """Standard deviation over seeds of the mean over scenes, for two or more seeds."""
    seeds: int = 0
    """Number of seeds that all scenes have."""
    scenes: int = 0
    expected: int = 1
    """Number of scenes."""
    not_converged: int = 0
    runs: int = 0
    paper: float | None = None
    """The published value, of the paper or another one; ``math.nan``: published as N.C."""
    rank: int = 0
    """Rank in the column: 1 for the best, 2 for the second best."""
    differences: list[Difference] = field(default_factory=list)

    @property
    def difference(self) -> float | None:
        return None if self.mean is None or self.paper is None or math.isnan(self.paper) else self.mean - self.paper


@dataclass
class Table:
    """A table of runs, ready to be written in any format."""

    title: str
    columns: list[Column]
    data: str = ""
    """Data set of the paper's values; empty: the table has none, or they have rows of their own."""
    rows: list[tuple[str, list[Cell]]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(
        self,
        rows: Rows,
        before: str = "",
        expected: int = 1,
        references: Callable[[list[Run], Column], Iterable[tuple[str, list[Run]]]] = lambda runs, column: (),
    ) -> None:
        """Add rows to the table, ranked among each other in each column; a cell that lacks a scene is not ranked.

        Args:
            rows: labels and runs of the rows.
            before: prefix of the labels.
            expected: number of scenes.
            references: function that gives the rows with which a row's runs are compared in a column.
        """
        grid = [[cell_of(runs, column, 1 if column.scene else expected) for column in self.columns] for _, runs in rows]
        for column, cells in zip(self.columns, zip(*grid, strict=True), strict=True):
            whole = [cell for cell in cells if cell.mean is not None and cell.scenes >= cell.expected]
            values = sorted({cell.mean for cell in whole}, reverse=METRICS[column.metric].higher)
            for cell in whole if len(values) > 1 else ():
                cell.rank = (1 + values.index(cell.mean)) * (cell.mean in values[:2])
            for cell, (_, runs) in zip(cells, rows, strict=True):
                for label, members in references(runs, column):
                    cell.differences += difference(label, column, runs, members)
        self.rows += [(before + label, cells) for (label, _), cells in zip(rows, grid, strict=True)]


def columns_of(metrics: Iterable[str], runs: Sequence[Run], nets: Iterable[str] = ()) -> list[Column]:
    """A column for each metric; one for each network of LPIPS where runs have several, or in addition to ``nets``."""
    networks = sorted({run.metrics["lpips_net"] for run in runs if run.metrics.get("lpips_net")} | set(nets))
    return [
        Column(f"{METRICS[metric].label} ({net})" if net else METRICS[metric].label, metric, net=net)
        for metric in metrics
        for net in (networks if len(networks) > 1 and metric.startswith("lpips") else [None])
    ]


def cell_of(runs: Sequence[Run], column: Column, expected: int = 1) -> Cell:
    """A row's scores in a column, of ``expected`` scenes."""
    members = [run for run in runs if column.scene in (None, run.scene)]
    # The clock's and the photographs' own are sound in any case.
    sound = column.metric.endswith("_photo") or (column.metric in METRICS and not METRICS[column.metric].of)
    scored: dict[str, dict[int, float]] = {}
    for run in members if sound or any(run.converged for run in members) else ():
        if (value := column.score(run)) is not None:
            scored.setdefault(run.scene, {})[run.seed] = value
    common = sorted(set.intersection(*map(set, scored.values()))) if scored else []
    by_seed = [statistics.fmean(of_scene[seed] for of_scene in scored.values()) for seed in common]
    return Cell(
        mean=statistics.fmean(statistics.fmean(each.values()) for each in scored.values()) if scored else None,
        std=statistics.stdev(by_seed) if len(by_seed) > 1 else None,
        seeds=len(common),
        scenes=len(scored),
        expected=expected,
        not_converged=0 if sound else sum(not run.converged for run in members),
        runs=len(members),
    )


def difference(against: str, column: Column, runs: Sequence[Run], reference: Sequence[Run]) -> list[Difference]:
    """The paired difference ``runs - reference`` over scenes and seeds that both have; empty where there is none."""
    theirs = {(run.scene, run.seed): column.score(run) for run in reference}
    both = [(column.score(run), theirs.get((run.scene, run.seed))) for run in runs]
    pairs = [value - other for value, other in both if value is not None and other is not None]
    if not pairs:
        return []
    mean, half, better = statistics.fmean(pairs), None, None
    if len(pairs) > 1:
        factor = float(student.ppf(0.5 + CONFIDENCE / 2, len(pairs) - 1))
        half = factor * statistics.stdev(pairs) / len(pairs) ** 0.5
        better = (mean > 0) == METRICS[column.metric].higher if abs(mean) > half else None
    return [Difference(against, mean, half, len(pairs), better)]
