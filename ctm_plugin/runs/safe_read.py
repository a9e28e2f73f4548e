"""Reading run directories that strangers may have made: plain values, inside the folder, no larger than the files."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from ctm_plugin.errors import CheckpointError

DEEPEST = 50
"""Lists and mappings inside one another, at most."""
Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times as fast, where libyaml is


def check_folder(run: Path) -> None:
    """Refuse a folder in which something leads out of it, or would block or never end when it is read.

    Raises:
        CheckpointError: it holds a link that leads outside, a pipe or a device.
    """
    root = run.resolve()
    for folder, folders, files in os.walk(run):
        for path in (Path(folder, name) for name in (*folders, *files)):
            if path.is_symlink() and not _leads_inside(path, root):
                raise CheckpointError(path, f"a link to {os.readlink(path)}", "nothing that leads out of the run")
            if path.exists() and not (path.is_file() or path.is_dir()):
                raise CheckpointError(path, "something that is not a file", "only files and folders")


def _leads_inside(path: Path, root: Path) -> bool:
    try:
        return path.resolve().is_relative_to(root)
    except (OSError, RuntimeError):  # a circle
        return False


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a mapping out of YAML that holds only plain values.

    Tags make objects, a few lines with aliases make gigabytes, and what is nested deeply ends libyaml's process: runs
    are saved with none of these.

    Raises:
        CheckpointError: it cannot be read, or holds something else.
    """
    try:
        text = path.read_text(encoding="utf-8")
        depth = 0
        for event in yaml.parse(text, Loader=Loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > DEEPEST or isinstance(event, yaml.AliasEvent) or getattr(event, "tag", None) is not None:
                raise CheckpointError(path, "no readable YAML (a tag, an alias, or too deep)", "plain values")
        value = yaml.load(text, Loader=Loader)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise CheckpointError(path, f"no readable YAML ({type(error).__name__})", "a run's configuration") from error
    return _mapping(value, path)


def read_json(path: Path) -> dict[str, Any]:
    """Read a mapping out of JSON.

    Raises:
        CheckpointError: it cannot be read, or holds something else.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(path, f"no readable JSON ({type(error).__name__})", "a run's file") from error
    return _mapping(value, path)


def _mapping(value: Any, path: Path) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise CheckpointError(path, "nothing" if value is None else f"a {type(value).__name__}", "a mapping")
    for node, key in nodes(value):
        if isinstance(node, dict) and not all(isinstance(name, str) for name in node):
            raise CheckpointError(path, f"a key that is no text{f' in {key}' if key else ''}", "names of settings")
    return value


def nodes(value: Any, key: str = "") -> Iterator[tuple[Any, str]]:
    """Go through a nest of dicts and lists: every value with its key, such as ``a.b.0``, the nest itself first."""
    waiting = [(value, key)]
    while waiting:
        value, key = waiting.pop()
        yield value, key
        if isinstance(value, dict | list):
            children = value.items() if isinstance(value, dict) else enumerate(value)
            waiting += [(child, f"{key}.{name}" if key else str(name)) for name, child in children]
