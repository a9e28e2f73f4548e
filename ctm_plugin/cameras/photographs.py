"""Which photographs lie in a folder; it is quick to import, so that a folder that cannot be used is refused at once."""

from __future__ import annotations

import os
import re
import shlex
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from ctm_plugin.cameras.left_out import left_out
from ctm_plugin.cameras.settings import FEWEST, USUAL
from ctm_plugin.data.readers.clip import CLIPS
from ctm_plugin.data.readers.folders import FOREIGN, IMAGE_SUFFIXES, RAWS, is_picture, others_hint
from ctm_plugin.data.readers.images import Picture, read_picture
from ctm_plugin.errors import DataError

PICTURES = (*IMAGE_SUFFIXES, *FOREIGN, *RAWS)
APART = re.compile(r"\..*|(images?_)?masks?|masks_\d+|depths?|sparse|colmap\w*|runs|left_out", re.IGNORECASE)
"""Folders that hold no photographs of their own."""
NUMBERS = re.compile(r"(\d+)").split
SYSTEMS = ("Thumbs.db", "desktop.ini")
"""What Windows leaves in folders."""
LONGEST = 300
"""Characters of a command that a message shows."""


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


def of_one_size(paths: Sequence[Path]) -> list[Picture]:
    """Read the headers of photographs.

    Raises:
        DataError: they have several sizes, or one cannot be read.
    """
    pictures = [read_picture(path) for path in paths]
    sizes = {each.path: f"{each.header.width}x{each.header.height}" for each in pictures}
    (most, _), *fewer = counted = Counter(sizes.values()).most_common()
    if fewer:
        folder = shlex.quote(str(paths[0].parent))
        others = [path.name for path, size in sizes.items() if size != most]
        command = f"cd {folder} && mkdir -p left_out && mv -- {shlex.join(others)} left_out"
        found = f"pictures of several sizes ({', '.join(f'{count} of {size}' for size, count in counted)})"
        way = f": {command}" if len(command) <= LONGEST else f"; move the {len(others)} others out of the folder"
        raise DataError(paths[0].parent, found, f"pictures of one size, all upright or all lying{way}")
    return pictures
