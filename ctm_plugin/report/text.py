"""Tables as Markdown, CSV and LaTeX; what a cell says is one for all formats."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence

from ctm_plugin.metrics.table import METRICS
from ctm_plugin.report.cells import Cell, Column, Difference, Table

ABOUT = "Mean over scenes; of several seeds the standard deviation, and their number in brackets. {best}, {second}."
PAPERS = " Paper: {data}, the paper's budget; its scenes are not ours unless the names say so."
NOT_CONVERGED = "N.C. (not converged): a run that is less than 1 dB better than the best constant colour."
ONE_SEED = "Differences of the same scene and seed. One seed: no interval."
PAIRED = (
    "Differences of the same scene and seed, converged or not: mean, 95 % confidence interval (Student's t), pairs in "
    "brackets. Better or worse: the interval leaves 0 out."
)


def ours(cell: Cell, decimals: int) -> str:
    """``mean ± std (seeds)``, with what did not converge."""
    if cell.mean is None:
        return "N.C." if cell.not_converged else "-"
    text = f"{cell.mean:.{decimals}f}"
    text += "" if cell.std is None else f" ± {cell.std:.{decimals}f}"
    text += f" ({cell.seeds})" if cell.seeds > 1 else ""
    text += f", {cell.scenes} of {cell.expected} scenes" if cell.scenes < cell.expected else ""
    return text + (f", {cell.not_converged} of {cell.runs} N.C." if cell.not_converged else "")


def paired(found: Difference, decimals: int) -> str:
    """``mean ± half (pairs)``, and what it says."""
    text = f"{found.mean:+.{decimals}f}"
    text += "" if found.half is None else f" ± {found.half:.{decimals}f} ({found.pairs})"
    return text + {True: " better", False: " worse", None: ""}[found.better]


def headings(table: Table) -> list[str]:
    """Of the columns of :func:`lines`."""
    found = [""]
    for column in table.columns:
        metric = METRICS[column.metric]
        unit = f", {metric.unit}" if metric.unit not in ("", "dB") else ""
        found += [f"{column.label}{unit} {metric.arrow}", *(("paper", "difference") if table.data else ())]
    return found


def lines(table: Table, best: str = "{}", second: str = "{}") -> list[list[str]]:
    """Rows as text; ``best`` and ``second`` say how these are written."""
    found = []
    for label, cells in table.rows:
        line = [label]
        for cell, column in zip(cells, table.columns, strict=True):
            decimals = METRICS[column.metric].decimals
            own = ("{}", best, second)[cell.rank].format(ours(cell, decimals))
            paper = "-" if cell.paper is None else "N.C." if math.isnan(cell.paper) else f"{cell.paper:.{decimals}f}"
            difference = "-" if cell.difference is None else f"{cell.difference:+.{decimals}f}"
            line += [own, paper, difference] if table.data else [own if cell.paper is None else paper]
        found.append(line)
    return found


def differences(table: Table) -> list[list[str]]:
    """Headings, and a line for each two rows with their paired differences; empty where there is none."""
    found: dict[str, dict[Column, str]] = {}
    for label, cells in table.rows:
        for cell, column in zip(cells, table.columns, strict=True):
            for each in cell.differences:
                texts = found.setdefault(f"{label} - {each.against}", {})
                texts[column] = paired(each, METRICS[column.metric].decimals)
    columns = [column for column in table.columns if any(column in texts for texts in found.values())]
    rows = [[label, *(texts.get(column, "-") for column in columns)] for label, texts in found.items()]
    return [["difference", *(column.label for column in columns)], *rows] if rows else []


def notes(table: Table, best: str = "**Best**", second: str = "_second best_") -> list[list[str]]:
    """What stands above a table, below it, and above its differences."""
    about = ABOUT.format(best=best, second=second) + (PAPERS.format(data=table.data) if table.data else "")
    below = [NOT_CONVERGED] if any("N.C." in cell for line in lines(table) for cell in line) else []
    several = any(each.pairs > 1 for _, cells in table.rows for cell in cells for each in cell.differences)
    return [[about, *table.notes], below, [PAIRED if several else ONE_SEED]]


def markdown(table: Table) -> str:
    """A table as Markdown, with all notes."""
    above, below, before = notes(table)
    parts = [f"### {table.title}", "", *above, ""]
    parts += [*_pipes([headings(table), *lines(table, "**{}**", "_{}_")]), *("\n" + each for each in below)]
    if found := differences(table):
        parts += ["", *before, "", *_pipes(found)]
    return "\n".join(parts) + "\n"


def _pipes(rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (rows[0], ["---"] * len(rows[0]), *rows[1:])]


def csv_text(tables: Sequence[Table]) -> str:
    """One line a row and column, or as many as the row is compared with others; numbers unrounded; empty where there is
    none, ``N.C.`` where nothing converged.
    """
    out = io.StringIO()
    scores = ("mean", "std", "seeds", "scenes", "runs", "not_converged", "paper", "difference")
    head = ("table", "row", "column", "metric", *scores, "paired_difference", "ci95_half", "pairs", "against")
    writer = csv.DictWriter(out, head, lineterminator="\n")
    writer.writeheader()
    for table in tables:
        for label, cells in table.rows:
            for cell, column in zip(cells, table.columns, strict=True):
                line = {name: getattr(cell, name) for name in scores}
                line |= {"table": table.title, "row": label, "column": column.label, "metric": column.metric}
                line |= {"mean": "N.C."} if cell.mean is None and cell.not_converged else {}
                line |= {"paper": "N.C."} if cell.paper is not None and math.isnan(cell.paper) else {}
                compared = [(each.mean, each.half, each.pairs, each.against) for each in cell.differences] or [()]
                writer.writerows(line | dict(zip(head[-4:], each, strict=False)) for each in compared)
    return out.getvalue()


def latex(table: Table) -> str:
    """A ``booktabs`` table."""
    heads = ["ours", "paper", "diff."] if table.data else ["ours"]
    arrows = {"↑": r"$\uparrow$", "↓": r"$\downarrow$"}
    groups = " & ".join(
        rf"\multicolumn{{{len(heads)}}}{{c}}{{{_escaped(column.label)} {arrows[METRICS[column.metric].arrow]}}}"
        for column in table.columns
    )
    rows = [" & ".join(map(_escaped, row)) + r" \\" for row in lines(table, r"\textbf{{{}}}", r"\underline{{{}}}")]
    said = _escaped(" ".join([*table.notes, *notes(table)[1]]))
    return "\n".join(
        [
            r"\begin{table}", r"\centering", rf"\caption{{{_escaped(table.title)}. {said}}}",
            rf"\begin{{tabular}}{{l{'r' * len(heads) * len(table.columns)}}}", r"\toprule",
            rf" & {groups} \\", " & ".join(["", *(heads * len(table.columns))]) + r" \\",
            r"\midrule", *rows, r"\bottomrule", r"\end{tabular}", r"\end{table}", "",
        ]
    )  # fmt: skip


def _escaped(text: str) -> str:
    """For LaTeX, whose marks are kept."""
    return re.sub(r"([&%#_])", r"\\\1", text).replace("±", r"$\pm$")


FORMATS = {
    "md": lambda tables: "\n".join(markdown(table) for table in tables),
    "csv": csv_text,
    "latex": lambda tables: "\n".join(latex(table) for table in tables),
}
"""Tables to text."""
