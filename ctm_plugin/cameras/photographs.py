"""Listing of a folder's photographs; quick to import, so that a folder that cannot be used is refused at once."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from ctm_plugin.cameras.left_out import left_out
from ctm_plugin.cameras.settings import DEFAULT_FOLDER, MIN_PICTURES
from ctm_plugin.data.readers.clip import CLIP_SUFFIXES
from ctm_plugin.data.readers.colmap_model import searched_in
from ctm_plugin.data.readers.folders import IMAGE_SUFFIXES, RAW_SUFFIXES, UNREAD_SUFFIXES, is_picture, others_hint
from ctm_plugin.data.readers.images import read_picture
from ctm_plugin.errors import CTMError, DataError

MODEL_FOLDER = Path("sparse", "0")
"""Folder inside the capture that ``ctm cameras`` writes its model to."""
PICTURE_SUFFIXES = (*IMAGE_SUFFIXES, *UNREAD_SUFFIXES, *RAW_SUFFIXES)
"""Suffixes of pictures: formats that are read, and formats that are only named in a message."""
NO_PHOTOGRAPHS = re.compile(r"\..*|(images?_)?masks?|masks_\d+|depths?|sparse|colmap\w*|runs|left_out", re.IGNORECASE)
"""Pattern of the names of folders that hold no photographs of a capture."""
SPLIT_DIGITS = re.compile(r"(\d+)").split
"""Splits a name at its numbers, so that 2 sorts before 10."""
BLACK = 1.5 / 255
"""Largest sRGB value of black pictures: the first grey level of 8 bits."""
SYSTEM_FILES = ("Thumbs.db", "desktop.ini")
"""Files that Windows leaves in folders."""


def below(folder: Path) -> list[Path]:
    """All files below a folder in natural order; folders named as in ``NO_PHOTOGRAPHS`` are skipped."""
    files = []
    for place, folders, names in os.walk(folder, followlinks=True):
        folders[:] = [name for name in folders if not NO_PHOTOGRAPHS.fullmatch(name)]
        files += [Path(place, name) for name in names if not name.startswith(".")]
    return sorted(files, key=lambda path: [int(part) if part.isdecimal() else part for part in SPLIT_DIGITS(str(path))])


def home_of(root: Path, name: str) -> Path:
    """The folder of the photographs in ``root``: that called ``name``; if ``name`` is the default and missing, the only
    folder with photographs, else ``root``.
    """
    place = root / name
    return place if place.is_dir() else home_and_files(root, name)[0]


def home_and_files(root: Path, name: str) -> tuple[Path, list[Path]]:
    """The folder of the photographs in ``root``, see :func:`home_of`, and all files :func:`below` it, in one walk."""
    place = root / name
    if name != DEFAULT_FOLDER or place.is_dir():
        return place, below(place)
    files = below(root)
    homes = [path.parent for path in files if path.suffix.lower() in PICTURE_SUFFIXES]
    if not homes:
        return place, []
    home = Path(root, *Path(os.path.commonpath(homes)).relative_to(root).parts[:1])
    return home, [path for path in files if path.is_relative_to(home)]


def list_photographs(root: Path, name: str) -> list[Path]:
    """List the pictures in the photographs' folder and below, in natural order, without those of :func:`left_out`.

    Raises a DataError for fewer than ``MIN_PICTURES``."""
    place, files = home_and_files(root, name)
    paths = [path for path in files if is_picture(path)]
    for what, others in left_out(paths).items():
        warnings.warn(f"{place}: {what} left out: {len(others)}, as {others[0].name!r}", stacklevel=2)
        paths = [path for path in paths if path not in others]
    if len(paths) < MIN_PICTURES:
        raise too_few(root, place, files, paths)
    known = (*IMAGE_SUFFIXES, *CLIP_SUFFIXES, *RAW_SUFFIXES)
    left = [path for path in files if path.suffix.lower() not in known and path.name not in SYSTEM_FILES]
    if left:
        warnings.warn(f"{place}: other files left out: {len(left)}, as {left[0].name!r}", stacklevel=2)
    return paths


def added(root: Path, name: str) -> list[str]:
    """List the photographs that were added after ``ctm cameras`` searched for the cameras of ``root``."""
    if not (there := searched_in(root / MODEL_FOLDER)):
        return []
    home = home_of(root, name)
    names = [path.relative_to(home).as_posix() for path in list_photographs(root, name)]
    return [each for each in names if each not in there]


def too_few(root: Path, place: Path, files: Sequence[Path], paths: Sequence[Path]) -> DataError:
    """Make the error that says why the folder ``place`` of ``root`` has fewer than ``MIN_PICTURES``: ``paths``."""
    if not place.is_dir():
        there = ", ".join(sorted(path.name for path in root.iterdir() if path.is_dir())) or "no folders"
        return DataError(root, there, f"photographs in {place.name}; for others, ctm cameras FOLDER pictures=NAME")
    count = sum(map(is_picture, files))
    with suppress(CTMError):  # those that cannot be read are not black
        if count >= MIN_PICTURES and all(float(read_picture(path).image()[..., :3].max()) <= BLACK for path in paths):
            return all_black(place, count)  # copies of one another
    foreign = [path for path in files if path.suffix.lower() in UNREAD_SUFFIXES]
    expected = f"at least {MIN_PICTURES} ending in {', '.join(IMAGE_SUFFIXES)}"
    if foreign:
        expected += f"; {others_hint(foreign)}"
    return DataError(place, f"{len(paths)} pictures", expected)


def all_black(place: Path, count: int) -> DataError:
    """Make the error for a folder all of whose pictures are black."""
    return DataError(place, f"{count} black pictures", "photographs with some light")
