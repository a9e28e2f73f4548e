"""Writing files so that a reader sees a whole one or none, from one process of several."""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any


def is_main_process() -> bool:
    """Tell whether this process writes the run's files: the only one, or the first of several."""
    return all(os.environ.get(name, "0") == "0" for name in ("RANK", "LOCAL_RANK", "SLURM_PROCID"))


@contextmanager
def naming(path: Path, *others: Path) -> Iterator[None]:
    """Context that names ``path`` in system errors that name no file, as of a full disk, or one of ``others``."""
    try:
        yield
    except OSError as error:
        if error.errno and error.filename in (None, *map(str, others)):
            error.filename = str(path)
        raise


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Context with a temporary path to write to; it replaces ``path`` if the block ends well, else it is removed."""
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with naming(path, beside):
            yield beside
            if beside.exists():  # only one of several processes writes
                os.replace(beside, path)
    finally:
        with suppress(OSError):  # as of a disk that may only be read: the block's own error names the file
            beside.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Context with a new folder to fill; it replaces ``path`` if the block ends well, else it is removed.

    What was there stays until then; of a link the link is replaced. The folder above is made, and goes if it stays
    empty.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    beside, before = (path.with_name(f".{path.name}.{os.getpid()}{end}") for end in ("", ".before"))
    try:
        beside.mkdir()
        yield beside
        if os.path.lexists(path):
            os.replace(path, before)
        os.replace(beside, path)
    finally:
        if os.path.lexists(before) and not os.path.lexists(path):  # stopped between the two
            os.replace(before, path)
        shutil.rmtree(beside, ignore_errors=True)
        before.unlink() if before.is_symlink() else shutil.rmtree(before, ignore_errors=True)
        with suppress(OSError):
            path.parent.rmdir()


def create(path: Path, text: str) -> None:
    """Write a new file, whole, where there must be none yet.

    Raises:
        FileExistsError: there is one, be it that another process has just written it.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        beside.write_text(text, encoding="utf-8")
        try:
            os.link(beside, path)
        except FileExistsError:
            raise
        except OSError:  # a file system without hard links
            if path.exists():
                raise FileExistsError(path) from None
            os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def check_zip(path: Path, max_bytes: int | None = None) -> None:
    """Read a ZIP file through and compare its check sums, which torch does not do.

    Args:
        path: the file.
        max_bytes: most bytes of content, unpacked; by default the file's size, where nothing should be packed.

    Raises:
        zipfile.BadZipFile: the file is damaged, no ZIP file, or holds more.
    """
    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > (max_bytes or path.stat().st_size):
            raise zipfile.BadZipFile("more than it should hold")
        if damaged := archive.testzip():
            raise zipfile.BadZipFile(damaged)


def write_text(path: Path, text: str) -> None:
    """Write a text, whole or not at all."""
    with replacing(path) as beside:
        beside.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write JSON, refusing NaN and infinity, which are not JSON."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")
