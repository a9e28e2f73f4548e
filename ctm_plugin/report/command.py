"""The verb ``report``: tables of finished runs."""

from __future__ import annotations

import sys
from pathlib import Path

from ctm_plugin.errors import CTMError
from ctm_plugin.files import replacing
from ctm_plugin.report.labels import find_runs
from ctm_plugin.report.settings import ReportConfig
from ctm_plugin.report.tables import choose
from ctm_plugin.report.text import FORMATS


def report(*runs: Path, settings: ReportConfig) -> None:
    """Read runs, given as their directories or as folders of them, and write tables.

    The first table has all runs, named by the settings in which they differ. Runs without scores are listed, with why.

    Raises:
        CTMError: there are none with scores, or what is asked for cannot be made of them.
    """
    asked, out = settings.format, settings.out and Path(settings.out)
    group = find_runs(runs)
    for why in group.left_out:
        print(f"left out: {why}", file=sys.stderr)
    if not group.runs:
        raise CTMError(f"{runs[0]}: found {len(group.left_out)} runs, none of them finished and whole, expected scores")
    if asked == "html":
        from ctm_plugin.report.page import page

        out = out or Path("report.html")
        text = page(choose(group, settings.table, settings.data), group, out.parent)
    else:
        text = FORMATS[asked](choose(group, settings.table, settings.data))
    if out is None:
        sys.stdout.write(text)
        return
    with replacing(out) as new:
        new.write_text(text, encoding="utf-8")
    print(f"written to {out}", file=sys.stderr)
