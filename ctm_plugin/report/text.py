"""Tables as Markdown, CSV and HTML; what a cell says is one for all formats."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from typing import NamedTuple

from ctm_plugin.metrics.table import METRICS
from ctm_plugin.report.cells import Cell, Column, Difference, Table

ABOUT = "Mean over scenes; of several seeds the standard deviation, and their number in brackets. {}, {}."
PAPERS = " Paper: {data}, the paper's budget; its scenes are not ours unless the names say so."
NOT_CONVERGED = "N.C. (not converged): a run that is less than 1 dB better than the best constant colour."
ONE_SEED = "Differences of the same scene and seed. One seed: no interval."
PAIRED = (
    "Differences of the same scene and seed, converged or not: mean, 95 % confidence interval (Student's t), pairs in "
    "brackets. Better or worse: the interval leaves 0 out."
)
RANK_MARKS = {"md": ("**{}**", "_{}_"), "html": ("{} ●", "{} ○")}
"""Templates that mark the best and the second best of a column by format."""
RANK_LEGENDS = {"md": ("**Best**", "_second best_"), "html": ("● best", "○ second best")}
"""Legends that explain the marks of ranks by format."""


class Written(NamedTuple):
    """A table as text: its grids, each a list of lines with the headings first, and the text above and below."""

    title: str
    above: list[str]
    lines: list[list[str]]
    below: list[str]
    about_differences: str
    differences: list[list[str]]


def spread(mean: float, std: float | None, decimals: int, sign: str = "") -> str:
    """Format ``mean ± std``, or only the mean where there is no deviation."""
    return f"{mean:{sign}.{decimals}f}" + ("" if std is None else f" ± {std:.{decimals}f}")


def written(table: Table, form: str) -> Written:
    """Write a table's cells as text for a format of :data:`RANK_MARKS`."""
    lines = [_headings(table), *(_line(table, *row, ("{}", *RANK_MARKS[form])) for row in table.rows)]
    about = ABOUT.format(*RANK_LEGENDS[form]) + (PAPERS.format(data=table.data) if table.data else "")
    below = [NOT_CONVERGED] if any("N.C." in cell for line in lines[1:] for cell in line) else []
    several = any(each.pairs > 1 for _, cells in table.rows for cell in cells for each in cell.differences)
    note = PAIRED if several else ONE_SEED
    return Written(table.title, [about, *table.notes], lines, below, note, _differences(table))


def _headings(table: Table) -> list[str]:
    headings = [""]
    for column in table.columns:
        metric = METRICS[column.metric]
        unit = f", {metric.unit}" if metric.unit not in ("", "dB") else ""
        headings += [f"{column.label}{unit} {metric.arrow}", *(("paper", "difference") if table.data else ())]
    return headings


def _line(table: Table, label: str, cells: Sequence[Cell], marks: Sequence[str]) -> list[str]:
    line = [label]
    for cell, column in zip(cells, table.columns, strict=True):
        decimals = METRICS[column.metric].decimals
        own = marks[cell.rank].format(_ours(cell, decimals))
        paper = "-" if cell.paper is None else "N.C." if math.isnan(cell.paper) else spread(cell.paper, None, decimals)
        apart = "-" if cell.difference is None else spread(cell.difference, None, decimals, "+")
        line += [own, paper, apart] if table.data else [own if cell.paper is None else paper]
    return line


def _ours(cell: Cell, decimals: int) -> str:
    """Format a cell as ``mean ± std (seeds)``, with the number of runs that did not converge."""
    if cell.mean is None:
        return "N.C." if cell.not_converged else "-"
    text = spread(cell.mean, cell.std, decimals)
    text += f" ({cell.seeds})" if cell.seeds > 1 else ""
    text += f", {cell.scenes} of {cell.expected} scenes" if cell.scenes < cell.expected else ""
    return text + (f", {cell.not_converged} of {cell.runs} N.C." if cell.not_converged else "")


def _differences(table: Table) -> list[list[str]]:
    """Grid of paired differences: headings, and a line for each two rows compared; empty where there are none."""
    texts_by_row: dict[str, dict[Column, str]] = {}
    for label, cells in table.rows:
        for cell, column in zip(cells, table.columns, strict=True):
            decimals = METRICS[column.metric].decimals
            for each in cell.differences:
                texts_by_row.setdefault(f"{label} - {each.against}", {})[column] = _paired(each, decimals)
    columns = [column for column in table.columns if any(column in texts for texts in texts_by_row.values())]
    rows = [[label, *(texts.get(column, "-") for column in columns)] for label, texts in texts_by_row.items()]
    return [["difference", *(column.label for column in columns)], *rows] if rows else []


def _paired(difference: Difference, decimals: int) -> str:
    """Format a difference as ``mean ± half (pairs)``, with a word on whether it is an improvement."""
    pairs = "" if difference.half is None else f" ({difference.pairs})"
    verdict = {True: " better", False: " worse", None: ""}[difference.better]
    return spread(difference.mean, difference.half, decimals, "+") + pairs + verdict


def pipes(lines: Sequence[Sequence[str]]) -> str:
    """Lines of cells as a table of Markdown, the headings first."""
    head, *body = [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines]
    return "\n".join([head, "|" + "---|" * len(lines[0]), *body])


def markdown(table: Table) -> str:
    """A table as Markdown, with all notes."""
    text = written(table, "md")
    parts = [f"### {text.title}", "", *text.above, "", pipes(text.lines), *("\n" + each for each in text.below)]
    if text.differences:
        parts += ["", text.about_differences, "", pipes(text.differences)]
    return "\n".join(parts) + "\n"


def csv_text(tables: Sequence[Table]) -> str:
    """Tables as CSV: a line for each row, column and comparison; numbers unrounded; empty where there is none,
    ``N.C.`` where nothing converged.
    """
    out = io.StringIO()
    scores = ("mean", "std", "seeds", "scenes", "runs", "not_converged", "paper", "difference")
    head = ("table", "row", "column", "metric", *scores, "paired_difference", "ci95_half", "pairs", "against")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(head)
    for table in tables:
        for label, cells in table.rows:
            for cell, column in zip(cells, table.columns, strict=True):
                line = {name: getattr(cell, name) for name in scores}
                line |= {"mean": "N.C."} if cell.mean is None and cell.not_converged else {}
                line |= {"paper": "N.C."} if cell.paper is not None and math.isnan(cell.paper) else {}
                for each in cell.differences or [None]:
                    compared = (each.mean, each.half, each.pairs, each.against) if each else ("",) * 4
                    writer.writerow((table.title, label, column.label, column.metric, *line.values(), *compared))
    return out.getvalue()


FORMATS = {"md": lambda tables: "\n".join(map(markdown, tables)), "csv": csv_text}
"""Functions that write tables as text, by format."""
