"""Which photographs lie in a folder; it is quick to import, so that a folder that cannot be used is refused at once."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

from ctm_plugin.cameras.left_out import left_out
from ctm_plugin.cameras.settings import FEWEST, USUAL
from ctm_plugin.data.readers.clip import CLIPS
from ctm_plugin.data.readers.colmap_model import searched_in
from ctm_plugin.data.readers.folders import FOREIGN, IMAGE_SUFFIXES, RAWS, is_picture, others_hint
from ctm_plugin.errors import DataError

MODEL = Path("sparse", "0")
"""Where ``ctm cameras`` writes."""
PICTURES = (*IMAGE_SUFFIXES, *FOREIGN, *RAWS)
APART = re.compile(r"\..*|(images?_)?masks?|masks_\d+|depths?|sparse|colmap\w*|runs|left_out", re.IGNORECASE)
"""Folders that hold no photographs of their own."""
NUMBERS = re.compile(r"(\d+)").split
SYSTEMS = ("Thumbs.db", "desktop.ini")
"""What Windows leaves in folders."""


def below(folder: Path) -> list[Path]:
    """The files of a folder and of those in it, by names, numbers as they count; not those in folders ``APART``."""
    found = []
    for place, folders, names in os.walk(folder, followlinks=True):
        folders[:] = [name for name in folders if not APART.fullmatch(name)]
        found += [Path(place, name) for name in names if not name.startswith(".")]
    return sorted(found, key=lambda path: [int(part) if part.isdecimal() else part for part in NUMBERS(str(path))])


def home_of(root: Path, name: str) -> Path:
    """The folder of the photographs in ``root``: of this ``name``; of the usual one, where that is not there, the only
    folder with some, else ``root``.
    """
    place = root / name
    elsewhere = name == USUAL and not place.is_dir()
    homes = [path.parent for path in below(root) if path.suffix.lower() in PICTURES] if elsewhere else []
    return Path(root, *Path(os.path.commonpath(homes)).relative_to(root).parts[:1]) if homes else place


def list_photographs(root: Path, name: str) -> list[Path]:
    """The pictures in :func:`home_of` and below it, by names, numbers as they count, but for what is left out."""
    place = home_of(root, name)
    files = below(place)
    paths = [path for path in files if is_picture(path)]
    for what, others in left_out(paths).items():
        warnings.warn(f"{place}: {len(others)} {what} are left out, as {others[0].name!r}", stacklevel=2)
        paths = [path for path in paths if path not in others]
    if len(paths) < FEWEST:
        raise too_few(root, place, files, len(paths))
    known = (*IMAGE_SUFFIXES, *CLIPS, *RAWS)
    left = [path for path in files if path.suffix.lower() not in known and path.name not in SYSTEMS]
    if left:
        warnings.warn(f"{place}: {len(left)} other files are left out, as {left[0].name!r}", stacklevel=2)
    return paths


def added(root: Path, name: str) -> list[str]:
    """Which photographs were not there when ``ctm cameras`` searched for the cameras of ``root``."""
    there, home = searched_in(root / MODEL), home_of(root, name)
    names = [path.relative_to(home).as_posix() for path in list_photographs(root, name)] if there else []
    return [each for each in names if each not in there]


def too_few(root: Path, place: Path, files: Sequence[Path], count: int) -> DataError:
    """Say why a folder ``place`` of ``root`` has too few pictures."""
    if not place.is_dir():
        there = ", ".join(sorted(path.name for path in root.iterdir() if path.is_dir())) or "no folders"
        return DataError(root, there, f"photographs in {place.name}; for others, ctm cameras FOLDER pictures=NAME")
    foreign = [path for path in files if path.suffix.lower() in FOREIGN]
    expected = f"at least {FEWEST} ending in {', '.join(IMAGE_SUFFIXES)}"
    if foreign:
        expected += f"; {others_hint(foreign)}"
    return DataError(place, f"{count} pictures", expected)
