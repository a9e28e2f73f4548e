"""Runs that the words of a command line name."""

from __future__ import annotations

from pathlib import Path

from ctm_plugin.errors import CheckpointError
from ctm_plugin.runs.rundir import CONFIG, LAST

NEWEST = Path("last")
HOMES = (Path("runs"), Path("multirun"))
"""Where runs are, unless their command lines said otherwise."""


def runs_of(path: Path) -> list[Path]:
    """Find the runs that a word names, the newest last.

    It is a run's directory, its last checkpoint, a folder of runs, or ``last``: the newest run there is, unless
    something has that name. What is none of these comes back as it is, for whoever reads it to refuse.

    Raises:
        CheckpointError: ``last`` is given, and there are no runs.
    """
    if path == NEWEST and not path.exists():
        if not (runs := _below(*HOMES)):
            raise CheckpointError(path, f"no run in {' or '.join(map(str, HOMES))}", "one")
        return runs[-1:]
    if path.is_file() and path.match(LAST):
        return [path.parents[1]]
    return [path] if (path / CONFIG).exists() else _below(path) or [path]


def _below(*folders: Path) -> list[Path]:
    """The runs in folders, by the time that each began; those in hidden folders are others' programs'."""
    configs = (config for folder in folders for config in folder.rglob(CONFIG))
    seen = [config for config in configs if not any(part.startswith(".") for part in config.parts if part != "..")]
    return [config.parent for config in sorted(seen, key=lambda config: (config.stat().st_mtime_ns, config))]
