"""``ctm list``: every choice of every group, in a line each."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from ctm_plugin.registry import BACKBONES, DATASETS, TRANSFORMS


def choices(conf: Path, group: str) -> dict[str, str]:
    """Names of a group with a line on each: the first comment of its file, or whose package it comes from."""
    found = {path.stem: first_comment(path) for path in sorted((conf / group).glob("*.yaml"))}
    registry = {"backbone": BACKBONES, "dataset": DATASETS, "ctm": TRANSFORMS}.get(group)
    for name, entry in ({} if registry is None else registry.others()).items():
        found.setdefault(name, f"from {entry.dist.name}" if entry.dist else "from another package")
    return dict(sorted(found.items()))


def first_comment(path: Path) -> str:
    """The first sentence of the first comment of a YAML file that is not Hydra's ``@package``."""
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("# ") and not line.startswith("# @package"):
            return line[2:].split(". ")[0].rstrip(".")
    return ""


def print_choices(console: Console, conf: Path, groups: tuple[str, ...]) -> None:
    """One table of all groups."""
    table = Table(box=None, pad_edge=False)
    for heading in ("group", "choice", ""):
        table.add_column(heading, no_wrap=heading != "", overflow="fold")
    for group in groups:
        for index, (name, line) in enumerate(choices(conf, group).items()):
            table.add_row(group if index == 0 else "", name, Text(line))  # not markup: brackets are extras
    console.print(table)
