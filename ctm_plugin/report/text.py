"""Gathered tables as Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence

from ctm_plugin.metrics.table import METRICS
from ctm_plugin.report.gather import Cell, Column, Comparison, Gathered


def ours(cell: Cell, metric: str) -> str:
    """``mean ± std (seeds)``, with what did not converge."""
    if cell.mean is None:
        return "N.C." if cell.not_converged else "-"
    decimals = METRICS[metric].decimals
    text = f"{cell.mean:.{decimals}f}"
    if cell.std is not None:
        text += f" ± {cell.std:.{decimals}f}"
    text += f" ({cell.seeds})" if cell.seeds > 1 else ""
    if cell.scenes < cell.expected:
        text += f", {cell.scenes} of {cell.expected} scenes"
    return f"{text}, {cell.not_converged} of {cell.runs} N.C." if cell.not_converged else text


def papers(cell: Cell, metric: str) -> str:
    if cell.paper is None:
        return "-"
    return "N.C." if math.isnan(cell.paper) else f"{cell.paper:.{METRICS[metric].decimals}f}"


def difference(cell: Cell, metric: str) -> str:
    return "-" if cell.difference is None else f"{cell.difference:+.{METRICS[metric].decimals}f}"


def interval(found: Comparison) -> str:
    """``mean ± half (pairs)``, and what it says."""
    decimals = METRICS[found.metric].decimals
    text = f"{found.mean:+.{decimals}f}"
    if found.half is not None:
        text += f" ± {found.half:.{decimals}f} ({found.pairs})"
    return text + {True: " better", False: " worse", None: ""}[found.better]


def headings(table: Gathered) -> list[str]:
    beside = ("paper", "difference") if table.data else ()
    return ["", *(head for each in table.columns for head in (_heading(each), *beside))]


def _heading(column: Column) -> str:
    metric = METRICS[column.metric]
    unit = f", {metric.unit}" if metric.unit not in ("", "dB") else ""
    return f"{column.label}{unit} {metric.arrow}"


def lines(table: Gathered, mark: dict[int, str]) -> list[list[str]]:
    """Cells as text; ``mark`` says how the best (1) and second best (2) are written."""
    return [
        [
            label,
            *(
                text
                for cell, column in zip(cells, table.columns, strict=True)
                for text in _texts(cell, column.metric, mark, bool(table.data))
            ),
        ]
        for label, cells in zip(table.labels, table.cells, strict=True)
    ]


def _texts(cell: Cell, metric: str, mark: dict[int, str], beside: bool) -> tuple[str, ...]:
    own = mark.get(cell.rank, "{}").format(ours(cell, metric))
    if beside:
        return own, papers(cell, metric), difference(cell, metric)
    return (own if cell.paper is None else papers(cell, metric),)


def against(table: Gathered) -> tuple[list[str], list[list[str]]]:
    """Paired differences: headings, and a line for each two rows with what there is in each column."""
    columns = [column for column in table.columns if any(each.column == column for each in table.comparisons)]
    found: dict[str, dict[Column, str]] = {}
    for each in table.comparisons:
        found.setdefault(each.label, {})[each.column] = interval(each)
    lines = [[label, *(texts.get(column, "-") for column in columns)] for label, texts in found.items()]
    return ["difference", *(column.label for column in columns)], lines


ABOUT = "Mean over scenes; of several seeds the standard deviation, and their number in brackets. {best}, {second}."
PAPERS = " Paper: {data}, the paper's budget; its scenes are not ours unless the names say so."
NOT_CONVERGED = "N.C. (not converged): a run that is less than 1 dB better than the best constant colour."
ONE_SEED = "Differences of the same scene and seed. One seed: no interval."
PAIRED = (
    "Differences of the same scene and seed, converged or not: mean, 95 % confidence interval (Student's t), pairs in "
    "brackets. Better or worse: the interval leaves 0 out."
)


def about(table: Gathered, best: str = "**Best**", second: str = "_second best_") -> str:
    """How a table is read."""
    return ABOUT.format(best=best, second=second) + (PAPERS.format(data=table.data) if table.data else "")


def below(table: Gathered) -> list[str]:
    """What explains a table's cells, if it has such."""
    return [NOT_CONVERGED] if any("N.C." in cell for line in lines(table, {}) for cell in line) else []


def paired(table: Gathered) -> str:
    """How a table's differences are read."""
    return PAIRED if any(each.pairs > 1 for each in table.comparisons) else ONE_SEED


def markdown(table: Gathered) -> str:
    parts = [f"### {table.title}", "", about(table), *table.notes, ""]
    parts += [*_pipes(headings(table), lines(table, {1: "**{}**", 2: "_{}_"})), *("\n" + each for each in below(table))]
    if table.comparisons:
        parts += ["", paired(table), "", *_pipes(*against(table))]
    return "\n".join(parts) + "\n"


def _pipes(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]


def csv_text(tables: Sequence[Gathered]) -> str:
    """One line a row and column, or as many as the row is compared with others; numbers unrounded; empty where there is
    none, ``N.C.`` where nothing converged.
    """
    out = io.StringIO()
    head = ["table", "row", "column", "metric", "mean", "std", "seeds", "scenes", "runs", "not_converged", "paper"]
    paired = ["paired_difference", "ci95_half", "pairs", "against"]
    csv.writer(out, lineterminator="\n").writerow([*head, "difference", *paired])
    for table in tables:
        _csv_rows(table, out)
    return out.getvalue()


def _csv_rows(table: Gathered, out: io.StringIO) -> None:
    writer = csv.writer(out, lineterminator="\n")
    for label, cells in zip(table.labels, table.cells, strict=True):
        for cell, column in zip(cells, table.columns, strict=True):
            mean = "N.C." if cell.mean is None and cell.not_converged else cell.mean
            paper = "N.C." if cell.paper is not None and math.isnan(cell.paper) else cell.paper
            row = [table.title, label, column.label, column.metric, mean, cell.std, cell.seeds, cell.scenes, cell.runs]
            against = f"{label} - "
            pairs = [
                [found.mean, found.half, found.pairs, found.label.removeprefix(against)]
                for found in table.comparisons
                if not column.scene and found.column == column and found.label.startswith(against)
            ]
            for pair in pairs or [[None] * 4]:
                writer.writerow([*row, cell.not_converged, paper, cell.difference, *pair])


def latex(table: Gathered) -> str:
    """A ``booktabs`` table."""
    heads = ["ours", "paper", "diff."] if table.data else ["ours"]
    groups = " & ".join(
        rf"\multicolumn{{{len(heads)}}}{{c}}{{{_escape(column.label)} {_arrow(column.metric)}}}"
        for column in table.columns
    )
    head = " & ".join(["", *(heads * len(table.columns))])
    marked = lines(table, {1: r"\textbf{{{}}}", 2: r"\underline{{{}}}"})
    rows = [" & ".join(_math(cell) for cell in row) + r" \\" for row in marked]
    notes = _escape(" ".join([*table.notes, *below(table)]))
    return "\n".join(
        [
            r"\begin{table}", r"\centering", rf"\caption{{{_escape(table.title)}. {notes}}}",
            rf"\begin{{tabular}}{{l{'r' * len(heads) * len(table.columns)}}}", r"\toprule",
            rf" & {groups} \\", rf"{head} \\",
            r"\midrule", *rows, r"\bottomrule", r"\end{tabular}", r"\end{table}", "",
        ]
    )  # fmt: skip


def _arrow(metric: str) -> str:
    return {"↑": r"$\uparrow$", "↓": r"$\downarrow$"}[METRICS[metric].arrow]


def _math(text: str) -> str:
    """A cell, whose marks are LaTeX already."""
    return re.sub(r"(?<!\\)([&%#_])", r"\\\1", text).replace("±", r"$\pm$")


def _escape(text: str) -> str:
    for character in "&%#_":
        text = text.replace(character, f"\\{character}")
    return text


FORMATS = {
    "md": lambda tables: "\n".join(markdown(table) for table in tables),
    "csv": csv_text,
    "latex": lambda tables: "\n".join(latex(table) for table in tables),
}
"""Tables to text."""
