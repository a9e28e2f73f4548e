"""Settings of reports; torch is not needed to check them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ctm_plugin.settings.setting import Settings, setting


@dataclass(frozen=True, kw_only=True)
class ReportConfig(Settings):
    """Settings of ``ctm report``: metrics, tables and formats."""

    table: int | None = setting(
        None, "number of the paper's table to show, 1 to 19; null: all runs, and the paper's tables that they fill"
    )
    data: str | None = setting(
        None,
        "name of the paper's data set whose values are shown next to runs of other data, such as Synthetic-NeRF-Dark",
    )
    format: str = setting("md", "format of tables: md, csv or html", choices=("md", "csv", "html"))
    out: str | None = setting(None, "file to write; null: standard output, report.html for html")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.out is not None and not Path(self.out).name:
            raise self.fault("out", "the name of a file")
