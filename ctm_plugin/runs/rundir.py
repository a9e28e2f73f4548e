"""A run directory: what is in it, and reading it without trusting it."""

from __future__ import annotations

import itertools
import os
import reprlib
import shlex
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from torch import Tensor

from ctm_plugin import __version__
from ctm_plugin.errors import CheckpointError
from ctm_plugin.files import check_zip, create
from ctm_plugin.runs.safe_read import check_folder, nodes, read_yaml
from ctm_plugin.settings.build import SECTIONS, Config

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None

CONFIG, METRICS, ERROR = "config.yaml", "metrics.json", "error.txt"
LAST, PREVIOUS, DAMAGED = (f"checkpoints/{name}.ckpt" for name in ("last", "previous", "damaged"))


def save_config(run: Path, config: Config) -> None:
    """Write the version and the resolved configuration into a new run directory, made if need be.

    Raises:
        CheckpointError: a run is there already, or nothing can be written there.
    """
    try:
        run.mkdir(parents=True, exist_ok=True)
        create(run / CONFIG, OmegaConf.to_yaml(OmegaConf.create({"version": __version__, **config})))
    except FileExistsError as error:
        raise there_already(run) from error
    except OSError as error:
        found = f"no directory to write to ({error.strerror})"
        raise CheckpointError(run, found, "a writable one, such as by hydra.run.dir=FOLDER") from error


def new_folder(first: Path) -> Path:
    """Make the folder of a new run, numbered where there are others: ``NAME``, ``NAME_2``, ..."""
    others = (first.with_name(f"{first.name}_{number}") for number in itertools.count(2))
    return next(filter(_taken, itertools.chain([first], others)))


def _taken(folder: Path) -> bool:
    """Whether this process, of all that are beginning runs, was the one to make ``checkpoints`` in a folder."""
    if (folder / CONFIG).exists():
        return False
    try:
        (folder / LAST).parent.mkdir(parents=True)
    except FileExistsError:
        return False
    return True


def note_colors(run: Path, found: str | None) -> None:
    """Let ``config.yaml`` say, in a comment, what was fitted to the scene's colours; ``None``: nothing was."""
    note = f"# fitted to the scene's colours: {found}\n"
    # Added to, not replaced: the lock is the file's.
    with (run / CONFIG).open("r+", encoding="utf-8") as file:
        if found and note not in file.readlines():
            file.write(note)


def there_already(run: Path) -> CheckpointError:
    """Make the error for a new run where there is one."""
    return CheckpointError(run, "a run that is there already", f"a new directory, or resume={shlex.quote(str(run))}")


@contextmanager
def locked(run: Path) -> Iterator[None]:
    """Keep a run to this process. The lock goes with the process, however it ends.

    Raises:
        CheckpointError: another process has it.
    """
    with (run / CONFIG).open("r+", encoding="utf-8") as file:  # for writing, as locks over a network want it
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                found = "another process at work on it"
                raise CheckpointError(run, found, "a run that no other process trains") from error
            except OSError:  # file systems without locks
                pass
        yield


def check_version(run: Path, version: Any) -> None:
    """Refuse a run of another minor version: its keys, its checkpoint or its defaults may mean something else.

    Raises:
        CheckpointError: it is of another one, or says none, as runs did before 0.6.
    """
    if not isinstance(version, str) or version.split(".")[:2] != __version__.split(".")[:2]:
        found = "0.5 or older" if version is None else reprlib.repr(version)
        raise CheckpointError(run, f"a run of version {found}", f"one of this version, {__version__}")


def load_config(run: Path) -> dict[str, Any]:
    """Read the configuration of a run, as plain containers: nothing in it is interpreted.

    Raises:
        CheckpointError: the folder is no run directory, is of another version, or its configuration cannot be read.
    """
    path = run / CONFIG
    if not run.is_dir():
        raise CheckpointError(run, "a file" if run.exists() else "no such directory", "a run directory")
    if not path.is_file():
        raise CheckpointError(run, f"no {CONFIG}", "a run directory")
    check_folder(run)
    config = read_yaml(path)
    check_version(run, config.pop("version", None))
    missing = [name for name in SECTIONS if not isinstance(config.get(name), dict)]
    if missing or "seed" not in config:
        raise CheckpointError(path, f"nothing for {', '.join(missing) or 'seed'}", "a run's configuration")
    # A stranger's could read the environment.
    if key := next((key for value, key in nodes(config) if isinstance(value, str) and "${" in value), None):
        raise CheckpointError(path, f"an interpolation at {key}", "the plain values that runs are saved with")
    return config


def load_checkpoint(run: Path, config: Config, name: str = LAST) -> dict[str, Any]:
    """Read a checkpoint of a run, by default the last one, with ``weights_only=True``.

    Raises:
        CheckpointError: there is none, it cannot be read (the one before it is offered), or it was made with another
            configuration.
    """
    path = run / name
    if not path.is_file():
        raise CheckpointError(run, f"no {name}", "a checkpoint")
    try:
        check_zip(path)
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # unpicklers raise anything on a damaged file
        before = shlex.quote(str(run / PREVIOUS))
        offer = f"; the one before it: python -m ctm_plugin resume={before}" if (run / PREVIOUS).is_file() else ""
        found = f"an unreadable file ({type(error).__name__})"
        raise CheckpointError(path, found, f"a checkpoint{offer if name == LAST else ''}") from error
    if not is_checkpoint(checkpoint):
        raise CheckpointError(path, "a file of another kind", "a checkpoint of ctm_plugin")
    check_tensors(checkpoint, path)
    # Where the data lie may change, see ctm_plugin.runs.data.
    differing = [key for key in differences(checkpoint["config"], config) if key != "dataset.root"]
    if differing:
        raise CheckpointError(
            path, f"another configuration (differs in {', '.join(differing)})", f"that of {run / CONFIG}"
        )
    return checkpoint


def is_checkpoint(content: Any) -> bool:
    """Tell whether this is what our runs save, as far as we read it ourselves."""
    if not isinstance(content, dict) or not all(
        isinstance(content.get(key), dict) for key in ("state_dict", "callbacks")
    ):
        return False
    steps, stopwatch = (
        [content.get(key) for key in ("batches_seen", "global_step")],
        content["callbacks"].get("Stopwatch"),
    )
    return (
        "config" in content
        and all(isinstance(step, int) and step >= 0 for step in steps)
        and isinstance(stopwatch, dict)
        and stopwatch.keys() == {"seconds", "peak_memory_mb"}
        and all(isinstance(value, float) for value in stopwatch.values())
    )


def check_tensors(content: Any, path: Path) -> None:
    """Refuse a checkpoint with tensors that claim to be larger than what is stored of them, or that hold no numbers.

    Raises:
        CheckpointError: there is such a tensor.
    """
    waiting, seen = [content], set()
    while waiting:
        value = waiting.pop()
        if id(value) in seen:  # pickles may hold a thing many times over, or inside itself
            continue
        seen.add(id(value))
        if isinstance(value, Tensor):
            if value.layout != torch.strided or value.nbytes > value.untyped_storage().nbytes():
                raise CheckpointError(path, f"a tensor {list(value.shape)} that is not stored whole", "one that is")
        elif isinstance(value, dict | list | tuple | set):
            waiting += [*value.keys(), *value.values()] if isinstance(value, dict) else value


def go_back(path: Path) -> Path:
    """Put the checkpoint before the last one in its place; a damaged last one is kept as ``damaged.ckpt``.

    Args:
        path: ``RUN/checkpoints/previous.ckpt``.

    Returns:
        The run.

    Raises:
        CheckpointError: it is another file, or cannot be used.
    """
    run = path.parent.parent
    if path.resolve() != (run / PREVIOUS).resolve():
        raise CheckpointError(path, "another file", f"a run directory, or its {PREVIOUS}")
    load_checkpoint(run, load_config(run), PREVIOUS)
    with locked(run):
        with suppress(FileNotFoundError):
            os.replace(run / LAST, run / DAMAGED)
        os.replace(run / PREVIOUS, run / LAST)
    return run


def differences(a: Any, b: Any, key: str = "") -> list[str]:
    """Find the keys at which two configurations differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        prefix = f"{key}." if key else ""
        return [found for k in sorted({*a, *b}) for found in differences(a.get(k), b.get(k), f"{prefix}{k}")]
    return [] if a == b else [key]
