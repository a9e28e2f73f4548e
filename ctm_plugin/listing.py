"""``ctm list``: every choice of every group, in a line each."""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from ctm_plugin.registry import REGISTRIES


def choices(conf: Path, group: str) -> dict[str, str]:
    """Names of a group with a line on each: the first comment of its file, the docstring of what is registered, which
    is read and not imported, or whose package it comes from."""
    found = {path.stem: first_comment(path) for path in (conf / group).glob("*.yaml")}
    if registry := REGISTRIES.get(group):
        found |= {} if group == "ctm" else {name: docstring(where) for name, where in registry.ours.items()}
        for name, entry in registry.others().items():
            found.setdefault(name, f"from {entry.dist.name}" if entry.dist else "from another package")
    return {name: line.split(". ")[0].rstrip(".") for name, line in sorted(found.items())}


def docstring(where: str) -> str:
    """The first line of the docstring of ``module:attribute``, without importing it."""
    module, attribute = where.split(":")
    tree = ast.parse(Path(find_spec(module).origin).read_text(encoding="utf-8"))
    (found,) = (node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == attribute)
    return ast.get_docstring(found).partition("\n")[0]


def first_comment(path: Path) -> str:
    """The first comment of a YAML file that is not Hydra's ``@package``."""
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("# ") and not line.startswith("# @package"):
            return line[2:]
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


def keys(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """The dotted keys of a choice and their values as YAML, but for ``name`` and ``preset``, where it names itself."""
    for name, value in node.items():
        if isinstance(value, Mapping):
            yield from keys(value, f"{prefix}{name}.")
        elif prefix or name not in ("name", "preset"):
            yield f"{prefix}{name}", value if isinstance(value, str) else json.dumps(value)


def print_keys(console: Console, group: str, node: Mapping[str, Any], meanings: Mapping[str, str]) -> None:
    """A table of a group's keys."""
    table = Table(box=None, pad_edge=False)
    for heading in ("key", "value", ""):
        table.add_column(heading, no_wrap=heading == "key", overflow="fold")
    for name, value in keys(node):
        table.add_row(f"{group}.{name}", Text(value), Text(meanings.get(name, "")))
    console.print(table)
