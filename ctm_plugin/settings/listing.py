"""``ctm list``: every choice of every group, in a line each."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from ctm_plugin.settings.registry import METRICS_OF_OTHERS, REGISTRIES


def plain(docstring: str, code: str = "") -> str:
    """A docstring for users, without its sections of arguments and errors; ``code`` is put round names in it."""
    text = re.split(r"\n\n(?:Args|Attributes|Returns|Raises):", docstring)[0]
    return re.sub(r":\w+:`~?(?:\w+\.)*(\w+)`", rf"{code}\1{code}", text).replace("``", code)


def names(conf: Path, group: str) -> list[str]:
    """Find the names of a group's choices, out of its files and its registry."""
    stems = {path.stem for path in (conf / group).glob("*.yaml")}
    if registry := REGISTRIES.get(group):
        stems |= {*registry.others(), *registry.added, *(() if group == "callbacks" else registry.ours)}
    return sorted(stems - {"ctm"})  # on and its variants are files


def choices(conf: Path, group: str) -> dict[str, str]:
    """Describe each choice of a group in a line: the first comment of its file, or its class's docstring."""
    lines = {}
    for name in names(conf, group):
        path = conf / group / f"{name}.yaml"
        if path.is_file():
            line = [*re.findall(r"^# ([^@].*)", path.read_text(encoding="utf-8"), re.M), ""][0]
        else:
            line = plain(REGISTRIES[group].about(name)).partition("\n")[0]
        lines[name] = line.split(". ")[0].rstrip(".")
    return lines


def print_choices(console: Console, conf: Path, groups: tuple[str, ...]) -> None:
    """Print one table of all groups, and of the scores that other packages bring."""
    lines = [(group, choices(conf, group)) for group in groups]
    lines.append(("metrics", {name: METRICS_OF_OTHERS.about(name) for name in METRICS_OF_OTHERS.names()}))
    rows = [(group if n == 0 else "", *line) for group, of_group in lines for n, line in enumerate(of_group.items())]
    print_rows(console, rows, ("group", "choice", ""))


def print_rows(console: Console, rows: Iterable[Sequence[str]], headings: Sequence[str] = ()) -> None:
    """Print rows of text as a table; only its last column may be broken into lines where it has headings."""
    table = Table(box=None, pad_edge=False, show_header=bool(headings))
    for heading in headings:
        table.add_column(heading, no_wrap=heading not in ("", "value"), overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))  # not markup: brackets are extras
    console.print(table)


def print_names(console: Console, conf: Path, groups: tuple[str, ...]) -> None:
    """Print the choices of some groups, by name, in a line each."""
    print_rows(console, [(f"{group}=", ", ".join(names(conf, group))) for group in groups])
    console.print("ctm list: what each is, the other groups, and keys", highlight=False)


def leaves(node: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Iterate over the dotted keys and values of a nested mapping's leaves."""
    for key, value in node.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def keys(node: Mapping[str, Any]) -> list[tuple[str, str]]:
    """List a choice's dotted keys and their values as YAML, but for its own ``name`` and ``preset``."""
    own = ((key, value) for key, value in leaves(node) if key not in ("name", "preset"))
    return [(key, value if isinstance(value, str) else json.dumps(value)) for key, value in own]


def print_keys(console: Console, group: str, node: Mapping[str, Any], meanings: Mapping[str, str]) -> None:
    """Print a table of a group's keys."""
    rows = [(f"{group}.{name}", value, meanings.get(name, "")) for name, value in keys(node)]
    print_rows(console, rows, ("key", "value", ""))
