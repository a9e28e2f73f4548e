"""Finished runs as tables or a figure."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ctm_plugin.errors import ConfigError, CTMError
from ctm_plugin.files import replacing
from ctm_plugin.report.evidence import evidence
from ctm_plugin.report.find import Found, find_runs, read_runs
from ctm_plugin.report.gather import Gathered, by_row, data_of, gather, with_papers
from ctm_plugin.report.lit import has_lit, lit_table
from ctm_plugin.report.overview import overview
from ctm_plugin.report.paper import TABLES, paper_table
from ctm_plugin.report.text import FORMATS
from ctm_plugin.settings.build import setting
from ctm_plugin.settings.check import check_choice

FIGURES = ("3", "4", "5", "6", "7", "8", "C")


@dataclass(frozen=True, kw_only=True)
class ReportConfig:
    """What to tell of the runs, and how."""

    table: int | None = setting(
        None, "number of the paper's table to show, 1 to 19; null: all runs, and the paper's tables that they fill"
    )
    data: str | None = setting(
        None,
        "name of the paper's data set whose values are shown next to runs of other data, such as Synthetic-NeRF-Dark",
    )
    figure: str | None = setting(
        None, "figure of the paper to draw instead of a table: 3 to 8, or C (appendix C's variances)"
    )
    format: str = setting(
        "md", "format of tables: md, csv, latex or html; evidence: one row of scores a run, added to the CSV file out"
    )
    out: str | None = setting(
        None,
        "file to write, for figures without ending; null: standard output, report.html for html, figure_N for figures",
    )

    def __post_init__(self) -> None:
        if self.figure is not None:
            check_choice("figure", self.figure, FIGURES)
        check_choice("format", self.format, (*FORMATS, "html", "evidence"))
        if self.out is not None and not Path(self.out).name:
            raise ConfigError("out", self.out, "the name of a file")


def report(*runs: Path, settings: ReportConfig) -> None:
    """Read runs, given as their directories or as folders of them, and write tables or a figure.

    The first table has all runs, named by the settings in which they differ. Runs without scores are listed, with why.

    Raises:
        CTMError: there are none with scores, or what is asked for cannot be made of them.
    """
    if settings.format == "evidence":
        _add_evidence(runs, settings.out)
        return
    found = find_runs(list(runs))
    for told in found.left_out:
        print(f"left out: {told}", file=sys.stderr)
    if not found.runs:
        raise CTMError(f"{runs[0]}: found {len(found.left_out)} runs, none of them finished and whole, expected scores")
    out = settings.out and Path(settings.out)
    if settings.figure:
        from ctm_plugin.report.figures import draw

        for path in draw(settings.figure, found.runs, out or Path(f"figure_{settings.figure}")):
            print(f"written to {path}")
        return
    tables = choose(found, settings.table, settings.data)
    if settings.format == "html":
        from ctm_plugin.report.page import page

        text = page(tables, found)
    else:
        text = FORMATS[settings.format](tables)
    if out is None and settings.format != "html":
        sys.stdout.write(text)
        return
    path = out or Path("report.html")
    with replacing(path) as beside:
        beside.write_text(text, encoding="utf-8")
    print(f"written to {path}", file=sys.stderr)


def _add_evidence(folders: Sequence[Path], out: str | None) -> None:
    runs, left_out = read_runs(folders)
    for why in left_out:
        print(f"left out: {why}", file=sys.stderr)
    text = evidence(runs, out and Path(out))
    if out is None:
        sys.stdout.write(text)
        return
    with replacing(Path(out)) as new:
        new.write_text(text, encoding="utf-8")
    print(f"{len(runs)} runs written to {out}", file=sys.stderr)


def choose(found: Found, number: int | None, data: str | None) -> list[Gathered]:
    """The table that was asked for; else all runs, lit views where there are references, and tables of the paper.

    These are of runs of the paper's data sets, each of those of Tables 1 to 7 that show most: a table of which one
    setting has runs is left out, and one whose settings all stand in another.
    """
    if data is not None:
        return [gather(paper_table(number or 1, data), found.runs)]
    if number is not None:
        table = paper_table(number)
        of_it = [run for _, members in by_row(table, found.runs) for run in members]
        return [gather(with_papers(table, of_it), found.runs)]
    tables = [overview(found.runs, found.shared)]
    if lit := [run for run in found.runs if has_lit(run)]:
        tables.append(lit_table(lit))
    for name in sorted({name for run in found.runs if (name := data_of(run))}):
        own = [run for run in found.runs if data_of(run) == name]
        possible = [table for each in TABLES.values() if (table := with_papers(each, own)).data]
        filled = [{run.setting for _, members in by_row(table, own) for run in members} for table in possible]
        tables += [
            gather(table, own)
            for index, (table, settings) in enumerate(zip(possible, filled, strict=True))
            if len(settings) > 1
            and not any(settings < other or (settings == other and first < index) for first, other in enumerate(filled))
        ]
    return tables
