"""``python -m ctm_plugin.report RUNS... [--table N | --figure N] [--format md|csv|latex|html] [--out FILE]``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from ctm_plugin.errors import CTMError
from ctm_plugin.files import replacing
from ctm_plugin.report.gather import Gathered, all_settings, by_row, gather
from ctm_plugin.report.paper import PER_METHOD, TABLES, paper_table
from ctm_plugin.report.runs import Run, find_runs
from ctm_plugin.report.text import FORMATS

FIGURES = ("3", "4", "5", "6", "7", "8", "C")


def main(arguments: Sequence[str] | None = None) -> int:
    """Read runs, write a report to standard output or ``--out``.

    Returns:
        The exit code: 0, or 1 where something cannot be used.
    """
    parser = argparse.ArgumentParser(prog="python -m ctm_plugin.report", description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUNS", help="run directories, or folders of them")
    parser.add_argument(
        "--table", type=int, help="a table of the paper; else all that the runs fill, or a list of them"
    )
    parser.add_argument("--data", help=f"whose values of Table 1: {', '.join(PER_METHOD)}")
    parser.add_argument("--figure", choices=FIGURES, help="a figure of the paper, or appendix C's variances")
    parser.add_argument("--format", choices=(*FORMATS, "html"), default="md")
    parser.add_argument("--out", type=Path, help="file to write; a figure's name without its ending")
    args = parser.parse_args(arguments)
    try:
        if args.out is not None and not args.out.name:
            raise CTMError(f"--out: found {args.out}, expected the name of a file")
        found = find_runs(args.runs)
        for told in found.unfinished:
            print(f"left out: {told}", file=sys.stderr)
        if not found.runs:
            raise CTMError(
                f"{args.runs[0]}: found {len(found.unfinished)} runs, none of them finished, expected scores"
            )
        if args.figure:
            from ctm_plugin.report.figures import draw

            for path in draw(args.figure, found.runs, args.out or Path(f"figure_{args.figure}")):
                print(f"written to {path}")
            return 0
        tables = choose(found.runs, args.table, args.data)
        if args.format == "html":
            from ctm_plugin.report.page import page

            text = page(tables, found)
        else:
            text = FORMATS[args.format](tables)
        if args.out is None and args.format != "html":
            sys.stdout.write(text)
            return 0
        path = args.out or Path("report.html")
        with replacing(path) as beside:
            beside.write_text(text, encoding="utf-8")
        print(f"written to {path}", file=sys.stderr)
    except (CTMError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def choose(runs: Sequence[Run], number: int | None, data: str | None) -> list[Gathered]:
    """The table that was asked for; else those of Tables 1 to 7 that show most, or a list of all settings.

    A table of which one setting alone has runs is left out, and one whose settings all stand in another: runs without
    CTM and with it fill a part of most tables.
    """
    if number is not None or data is not None:
        return [gather(paper_table(number or 1, data), runs)]
    filled = {
        table.number: {run.setting for _, members in by_row(table, runs) for run in members}
        for table in TABLES.values()
    }
    shown = [
        number
        for number, settings in filled.items()
        if len(settings) > 1
        and not any(settings < other or (settings == other and first < number) for first, other in filled.items())
    ]
    return [gather(TABLES[number], runs) for number in shown] or [gather(all_settings(runs), runs)]


if __name__ == "__main__":
    sys.exit(main())
