"""Finished runs as tables or a figure."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ctm_plugin.color.light import factor_of
from ctm_plugin.errors import ConfigError, CTMError
from ctm_plugin.files import replacing
from ctm_plugin.report.alike import scenes_apart
from ctm_plugin.report.colors import colors_table, has_colors
from ctm_plugin.report.find import find_runs
from ctm_plugin.report.gather import Gathered, all_settings, by_row, gather, without_papers
from ctm_plugin.report.lit import has_lit, lit_table
from ctm_plugin.report.paper import TABLES, paper_table
from ctm_plugin.report.runs import Run, has_appearances
from ctm_plugin.report.text import FORMATS
from ctm_plugin.settings.build import setting
from ctm_plugin.settings.check import check_choice

FIGURES = ("3", "4", "5", "6", "7", "8", "C")


@dataclass(frozen=True, kw_only=True)
class ReportConfig:
    """What to tell of the runs, and how."""

    table: int | None = setting(
        None, "number of a table of the paper, 1 to 19; else all that the runs fill, or a list of them"
    )
    data: str | None = setting(None, "on which data set the paper's values of Table 1 are, such as Synthetic-NeRF-Dark")
    figure: str | None = setting(None, "a figure of the paper instead, 3 to 8, or C, appendix C's variances")
    format: str = setting("md", "of tables: md, csv, latex or html")
    light: str = setting(
        "auto",
        "of lifted pictures: auto shows those that runs have written, a number of stops has them rendered again, "
        "off leaves them out",
    )
    out: str | None = setting(
        None, "file to write; a figure's name without its ending. Else standard output, report.html, figure_N"
    )

    def __post_init__(self) -> None:
        factor_of(self.light, 1.0)
        if self.figure is not None:
            check_choice("figure", self.figure, FIGURES)
        check_choice("format", self.format, (*FORMATS, "html"))
        if self.out is not None and not Path(self.out).name:
            raise ConfigError("out", self.out, "the name of a file")


def report(*runs: Path, settings: ReportConfig) -> None:
    """Read runs, given as their directories or as folders of them, and write tables or a figure.

    Raises:
        CTMError: there are none with scores, or what is asked for cannot be made of them.
    """
    found = find_runs(list(runs))
    for told in found.left_out:
        print(f"left out: {told}", file=sys.stderr)
    if not found.runs:
        raise CTMError(f"{runs[0]}: found {len(found.left_out)} runs, none of them finished and whole, expected scores")
    found = found._replace(runs=[replace(run, light=settings.light) for run in found.runs])
    if has_colors(found.runs) or has_appearances(found.runs):
        found = found._replace(runs=scenes_apart(found.runs))
    out = settings.out and Path(settings.out)
    if settings.figure:
        from ctm_plugin.report.figures import draw

        for path in draw(settings.figure, found.runs, out or Path(f"figure_{settings.figure}")):
            print(f"written to {path}")
        return
    tables = choose(found.runs, settings.table, settings.data)
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


def choose(runs: Sequence[Run], number: int | None, data: str | None) -> list[Gathered]:
    """The table that was asked for; else one of the runs with lit views, and beside it that of ``experiment=colors``
    where runs are of it, else those of Tables 1 to 7 that show most, and a list of all settings where one is in none.

    A table of which one setting alone has runs is left out, and one whose settings all stand in another: runs without
    CTM and with it fill a part of most tables. The paper's values stand beside those of the paper's scenes and of the
    package's, and where ``data`` says what they are to be compared with.
    """
    if data is not None:
        return [gather(paper_table(number or 1, data), runs)]
    if number is not None:
        return [gather(without_papers(paper_table(number), runs), runs)]
    lit = [run for run in runs if has_lit(run)]
    if has_colors(runs):
        return [*([lit_table(lit)] if lit else []), colors_table(runs)]
    others = [run for run in runs if not has_lit(run)]
    filled = {
        table.number: {run.setting for _, members in by_row(table, others) for run in members}
        for table in TABLES.values()
    }
    shown = [
        number
        for number, settings in filled.items()
        if len(settings) > 1
        and not any(settings < other or (settings == other and first < number) for first, other in filled.items())
    ]
    tables = [gather(without_papers(TABLES[number], others), others) for number in shown]
    if {run.setting for run in others} - {setting for number in shown for setting in filled[number]}:
        tables += [gather(all_settings(others), others)]
    return [lit_table(lit), *tables] if lit else tables
