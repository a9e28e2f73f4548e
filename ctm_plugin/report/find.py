"""Finished runs below some folders, and why others are left out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ctm_plugin.errors import CheckpointError, printable
from ctm_plugin.report.apart import scenes_apart, set_apart, without_what_scenes_share
from ctm_plugin.report.runs import CONFIG, METRICS, Run, read_run
from ctm_plugin.runs.safe_read import check_folder

ERROR = "error.txt"
TOLD = 10_000
"""Characters of a failed run's error that are shown."""


class Found(NamedTuple):
    """Runs below some folders."""

    runs: list[Run]
    left_out: list[str]
    """Folders of other runs, each with the reason: no scores yet, the error that a sweep saw, damaged, doubled."""
    shared: list[str]
    """What all runs of a backbone on a scene share, and those on others do not."""


def find_runs(folders: Sequence[Path]) -> Found:
    """All runs in folders and below them that can be reported on, and what is left out.

    Raises:
        CheckpointError: a folder is missing or holds no run.
    """
    whole, left_out = read_runs(folders)
    runs, shared = without_what_scenes_share(set_apart(scenes_apart(whole)))
    runs, doubles = without_doubles(runs)
    return Found(runs, left_out + doubles, shared)


def read_runs(folders: Sequence[Path]) -> tuple[list[Run], list[str]]:
    """All runs in folders and below them as their files have them, and why others are left out.

    Raises:
        CheckpointError: a folder is missing or holds no run.
    """
    found: dict[Path, Run | str] = {}
    for folder in folders:
        if not folder.is_dir():
            raise CheckpointError(folder, "no such directory", "a run directory, or a folder of them")
        paths = sorted({path.parent for name in (CONFIG, ERROR) for path in folder.rglob(name)})
        if not paths:
            raise CheckpointError(folder, f"no {CONFIG} in it or below", "a run directory, or a folder of them")
        for run in paths:
            if run.resolve() not in found:
                found[run.resolve()] = _run_or_reason(run)
    runs = [run for run in found.values() if isinstance(run, Run)]
    return runs, [why for why in found.values() if isinstance(why, str)]


def _run_or_reason(folder: Path) -> Run | str:
    """A run, or why it is none that can be reported on."""
    try:
        check_folder(folder)
        return read_run(folder) if (folder / METRICS).exists() else _why_unfinished(folder.resolve())
    except CheckpointError as error:
        return str(error)


def without_doubles(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Keep the newest of runs that have one scene, seed and setting; tell of the others."""
    newest: dict[tuple, Run] = {}
    for run in sorted(runs, key=lambda run: (run.folder / METRICS).stat().st_mtime_ns):
        newest[run.scene, run.seed, run.setting] = run
    told = [
        f"{run.folder}: the same run as {other.folder}, which is newer and is counted"
        for run in runs
        if (other := newest[run.scene, run.seed, run.setting]) is not run
    ]
    return [run for run in runs if newest[run.scene, run.seed, run.setting] is run], told


def _why_unfinished(folder: Path) -> str:
    if not (folder / ERROR).is_file():
        return f"{folder}: not finished"
    with (folder / ERROR).open(encoding="utf-8", errors="replace") as file:
        return "\n".join(printable(line) for line in f"{folder}: {file.read(TOLD).strip()}".splitlines())
