"""Runs of a sweep, which may have been begun in an earlier call."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from ctm_plugin.data.capture import Capture
from ctm_plugin.errors import CheckpointError
from ctm_plugin.runs.rundir import CONFIG, ERROR, METRICS, load_config, new_folder, read_json
from ctm_plugin.runs.train import resume, train
from ctm_plugin.settings.build import Config
from ctm_plugin.show.console import print_line


def go_on(config: Config, sweep: Path, folder: Path, capture: Capture | None = None) -> dict[str, Any]:
    """Do a sweep's run: if it was begun earlier, a finished one stays as it is, an interrupted one is resumed.

    Runs are recognised by their configuration, so that their numbers in the sweep may differ from earlier.

    Args:
        config, sweep: the resolved configuration, and the sweep's folder.
        folder: folder of a new run; a folder next to it where that is taken.
        capture: the capture of the run's data, where it has been read already.

    Returns:
        The content of ``metrics.json``.
    """
    for run in sorted(path.parent for path in sweep.glob(f"*/{CONFIG}")):
        same = False
        with suppress(CheckpointError):  # of another version, or damaged: not this one
            same = same_run(load_config(run), config)
        if not same:
            continue
        if (run / METRICS).is_file():
            metrics = read_json(run / METRICS)
            print_line(metrics, run, "finished before: ")
            return metrics
        (run / ERROR).unlink(missing_ok=True)
        return resume(run, print_line)
    return train(config, new_folder(folder), print_line, capture)


def finished(sweep: Path) -> list[tuple[Config, dict[str, Any]]]:
    """Read configurations and scores of a sweep's finished runs; what cannot be read is left out."""
    results = []
    for path in sorted(sweep.glob(f"*/{METRICS}")):
        with suppress(CheckpointError):
            results.append((load_config(path.parent), read_json(path)))
    return results


def same_run(saved: Config, config: Config) -> bool:
    """Tell whether a saved configuration equals a new one; the saved one holds the precision that ``auto`` came to."""
    trainer = dict(config["trainer"])
    if trainer.get("precision") == "auto":
        trainer["precision"] = saved["trainer"].get("precision")
    return saved == {**config, "trainer": trainer}
