"""The data of a run: the folder where they lie now, and a check that they are those it was trained on."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ctm_plugin.errors import CheckpointError, ConfigError
from ctm_plugin.files import is_main_process, write_json
from ctm_plugin.runs.provenance import fingerprints
from ctm_plugin.runs.rundir import differences, read_json
from ctm_plugin.settings.build import Config

DATA_FILE = "data.json"
"""Name of a run's note on its data: the folder, absolute and relative to the run, and fingerprints of its parts."""


def note_data(run: Path, config: Config, scene: Any) -> None:
    """Write a run's note on its data: folder and fingerprints."""
    folder = config["dataset"].get("root")
    places = {}
    if folder is not None:
        home = Path(folder).expanduser().resolve()
        places = {"root": str(home), "from_run": os.path.relpath(home, run.resolve())}
    write_json(run / DATA_FILE, {**places, "parts": fingerprints(scene)})


def located(config: Config, run: Path, root: str | None = None) -> Config:
    """Find the folder where a run's data lie now; give the run's configuration with it.

    Places tried: its absolute path, its path relative to the run, and its name in the folders above the run.

    Raises:
        ConfigError: ``root`` is given, but the run's data have no folder.
        CheckpointError: the folder is not found.
    """
    node = config["dataset"]
    if "root" not in node:
        if root is not None:
            raise ConfigError("dataset.root", root, f"nothing: the data of dataset={node.get('name')} have no folder")
        return config
    if root is None:
        places = list(_places(str(node["root"]), run))
        root = next((place for place in places if Path(place).expanduser().exists()), None)
        if root is None:
            raise CheckpointError(
                run, f"none of its data at {places[0]}", "them there, or dataset.root=FOLDER, where they are now"
            )
    return {**config, "dataset": {**node, "root": root}}


def _places(root: str, run: Path) -> Iterator[str]:
    note = _note(run)
    if isinstance(home := note.get("root"), str):
        yield home
    if isinstance(way := note.get("from_run"), str):
        yield os.path.normpath(run.resolve() / way)
    yield root
    if not Path(root).expanduser().is_absolute():
        yield from (str(folder / root) for folder in run.resolve().parents)


def _note(run: Path) -> dict[str, Any]:
    return read_json(run / DATA_FILE) if (run / DATA_FILE).is_file() else {}  # none: killed before it was written


def check_data(run: Path, scene: Any, refuse: bool = False) -> bool:
    """Compare a scene's fingerprints with those of a run's training data; warn once, or ``refuse``, if they differ.

    Returns:
        Whether the data are known to be the same.

    Raises:
        CheckpointError: the data differ, and ``refuse`` is set.
    """
    before = _note(run).get("parts")
    if not is_main_process() or not isinstance(before, dict):
        return False
    if not (changed := [name for name in differences(before, fingerprints(scene)) if name != "name"]):
        return True
    found = f"other data than it was trained on: {', '.join(changed)} changed"
    if refuse:
        expected = "the same; resume= with dataset.root=FOLDER goes on with the data in FOLDER although they differ"
        raise CheckpointError(run, found, expected)
    warnings.warn(f"{run}: {found}; scores and pictures are not those of the training's data", stacklevel=2)
    return False
