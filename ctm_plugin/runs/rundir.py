"""Run directories: finding them by name, and writing and reading their files without executing anything."""

from __future__ import annotations

import fcntl
import itertools
import json
import reprlib
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf

from ctm_plugin import __version__
from ctm_plugin.errors import CheckpointError
from ctm_plugin.files import create
from ctm_plugin.settings.build import SECTIONS, Config

CONFIG, METRICS, ERROR, PAGE = "config.yaml", "metrics.json", "error.txt", "index.html"
ALL = "all"
"""Name of the folder of all lit views, training views included."""
LAST, PREVIOUS, DAMAGED = (f"checkpoints/{name}.ckpt" for name in ("last", "previous", "damaged"))
NEWEST_LINK = Path("last")
"""Link to the newest run."""
RUN_FOLDERS = (Path("runs"), Path("multirun"))
"""Folders that hold runs, by default."""
Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times as fast, where libyaml is


# Which one.


def runs_of(path: Path) -> list[Path]:
    """Find the runs that a word names, the newest last.

    The word is a run's directory, its last checkpoint, a folder of runs, or ``last``: the newest run there is, unless
    a file has that name. Any other path is returned unchanged, and refused when it is read.

    Raises:
        CheckpointError: ``last`` is given, and there are no runs.
    """
    if path == NEWEST_LINK and not path.exists():
        if not (runs := _below(*RUN_FOLDERS)):
            raise CheckpointError(path, f"no run in {' or '.join(map(str, RUN_FOLDERS))}", "one")
        return runs[-1:]
    if path.is_file() and path.match(LAST):
        return [path.parents[1]]
    return [path] if (path / CONFIG).exists() else _below(path) or [path]


def _below(*folders: Path) -> list[Path]:
    """The runs in folders, by the time that each began; hidden folders, which belong to other programs, are skipped."""
    configs = (config for folder in folders for config in folder.rglob(CONFIG))
    seen = [config for config in configs if not any(part.startswith(".") for part in config.parts if part != "..")]
    return [config.parent for config in sorted(seen, key=lambda config: (config.stat().st_mtime_ns, config))]


def new_folder(first: Path) -> Path:
    """Make the folder of a new run, numbered where there are others: ``NAME``, ``NAME_2``, ..."""
    others = (first.with_name(f"{first.name}_{number}") for number in itertools.count(2))
    return next(filter(_taken, itertools.chain([first], others)))


def _taken(folder: Path) -> bool:
    """Whether this process, and no other that begins a run, made the folder ``checkpoints`` in a run's folder."""
    if (folder / CONFIG).exists():
        return False
    try:
        (folder / LAST).parent.mkdir(parents=True)
    except FileExistsError:
        return False
    return True


def film_of(run: Path) -> Path | None:
    """Find a run's newest film."""
    return max((run / "video").glob("[!.]*.*"), key=lambda film: film.stat().st_mtime_ns, default=None)


# Its configuration.


def save_config(run: Path, config: Config) -> None:
    """Write the version and the resolved configuration into a new run directory, made if need be.

    Raises:
        CheckpointError: the directory has a run already, or cannot be written.
    """
    try:
        run.mkdir(parents=True, exist_ok=True)
        create(run / CONFIG, OmegaConf.to_yaml(OmegaConf.create({"version": __version__, **config})))
    except FileExistsError as error:
        raise there_already(run) from error
    except OSError as error:
        found = f"no directory to write to ({error.strerror})"
        raise CheckpointError(run, found, "a writable one, to start in or by hydra.run.dir=FOLDER") from error


def there_already(run: Path) -> CheckpointError:
    """Make the error for a new run in a directory that has a run."""
    return CheckpointError(run, "a run that is there already", f"a new directory, or resume={shlex.quote(str(run))}")


def note_colors(run: Path, description: str | None) -> None:
    """Add the description of the transform's fit to ``config.yaml``, as a comment; ``None``: there is no fit."""
    note = f"# fitted to the scene's colours: {description}\n"
    # Added to, not replaced: the lock is the file's.
    with (run / CONFIG).open("r+", encoding="utf-8") as file:
        if description and note not in file.readlines():
            file.write(note)


@contextmanager
def locked(run: Path) -> Iterator[None]:
    """Context that locks a run's directory for this process. The lock goes with the process, however it ends.

    Raises:
        CheckpointError: another process holds the lock.
    """
    with (run / CONFIG).open("r+", encoding="utf-8") as file:  # for writing, as locks over a network want it
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            found = "another process at work on it"
            raise CheckpointError(run, found, "a run that no other process trains") from error
        except OSError:  # file systems without locks
            pass
        yield


def load_config(run: Path) -> dict[str, Any]:
    """Read the configuration of a run, as plain containers: nothing in it is interpreted.

    Raises:
        CheckpointError: the folder is no run directory, is of another version (its keys, its checkpoint or its defaults
            may mean something else), or its configuration cannot be read.
    """
    path = run / CONFIG
    if not run.is_dir():
        raise CheckpointError(run, "a file" if run.exists() else "no such directory", "a run directory")
    if not path.is_file():
        raise CheckpointError(run, f"no {CONFIG}", "a run directory")
    config = read_yaml(path)
    version = config.pop("version", None)
    if not isinstance(version, str) or version.split(".")[:2] != __version__.split(".")[:2]:
        wrote = "0.5 or older" if version is None else reprlib.repr(version)
        raise CheckpointError(run, f"a run of version {wrote}", f"one of this version, {__version__}")
    missing = [name for name in SECTIONS if not isinstance(config.get(name), dict)]
    if missing or "seed" not in config:
        raise CheckpointError(path, f"nothing for {', '.join(missing) or 'seed'}", "a run's configuration")
    # A stranger's could read the environment.
    if key := next((key for value, key in nodes(config) if isinstance(value, str) and "${" in value), None):
        raise CheckpointError(path, f"an interpolation at {key}", "the plain values that runs are saved with")
    return config


def differences(a: Any, b: Any, key: str = "") -> list[str]:
    """Find the keys at which two configurations differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        prefix = f"{key}." if key else ""
        return [line for k in sorted({*a, *b}) for line in differences(a.get(k), b.get(k), f"{prefix}{k}")]
    return [] if a == b else [key]


# Reading what strangers may have made: plain values.


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a mapping of plain values out of YAML; tags, which make objects, and aliases, which may loop, are refused.

    Raises:
        CheckpointError: it cannot be read, or holds something else.
    """
    try:
        text = path.read_text(encoding="utf-8")
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, Loader=Loader)):
            raise ValueError("an alias")
        value = yaml.load(text, Loader=Loader)
    except (OSError, LookupError, ValueError, yaml.YAMLError) as error:
        raise CheckpointError(path, f"no readable YAML ({type(error).__name__})", "plain values") from error
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
    """Iterate over nested containers: every value with its dotted key, such as ``a.b.0``, the outermost first."""
    waiting = [(value, key)]
    while waiting:
        value, key = waiting.pop()
        yield value, key
        if isinstance(value, dict | list | tuple):
            children = value.items() if isinstance(value, dict) else enumerate(value)
            waiting += [(child, f"{key}.{name}" if key else str(name)) for name, child in children]
