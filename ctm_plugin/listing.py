"""``ctm list``: every choice of every group, in a line each."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from ctm_plugin.registry import BY_GROUP

USAGE = """\
python -m ctm_plugin [group=choice ...] [key=value ...]     one run
python -m ctm_plugin -m group=a,b key=range(3) ...          all combinations; sweep.resume=true goes on with a sweep
python -m ctm_plugin resume=RUN_DIR                         go on with a run
python -m ctm_plugin --cfg job [group=choice ...]           every key that a command line comes to, without running it
python -m ctm_plugin list                                   what there is to choose
python -m ctm_plugin.demo | .evaluate | .report | .render | .view | .benchmark | .scenes    other commands
"""


def choices(conf: Path, group: str) -> dict[str, str]:
    """Names of a group with a line on each: the first comment of its file, or whose package it comes from."""
    found = {path.stem: first_comment(path) for path in sorted((conf / group).glob("*.yaml"))}
    registry = BY_GROUP.get(group)
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
