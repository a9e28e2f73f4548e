"""Which photographs lie in a folder; it is quick to import, so that a folder that cannot be used is refused at once."""

from __future__ import annotations

import re
import shlex
import warnings
from collections.abc import Sequence
from pathlib import Path

from ctm_plugin.cameras.settings import FEWEST
from ctm_plugin.data.readers.colmap_model import searched_in
from ctm_plugin.data.readers.folders import FOREIGN, IMAGE_SUFFIXES, is_picture, others_hint
from ctm_plugin.errors import DataError

VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
MODEL = Path("sparse", "0")
"""Where ``ctm cameras`` writes."""
PICTURES = (*IMAGE_SUFFIXES, *FOREIGN)


def list_photographs(root: Path, name: str) -> list[Path]:
    """The pictures in a folder of ``root``, or in itself where that is not there, by names, numbers as they count."""
    loose = not (root / name).is_dir() and any(path.suffix.lower() in PICTURES for path in root.iterdir())
    place = root if loose else root / name
    files = sorted(path for path in place.glob("*") if path.is_file() and not path.name.startswith("."))
    paths = [path for path in files if is_picture(path)]
    if len(paths) < FEWEST:
        raise too_few(root, place, files, len(paths))
    if others := [path.name for path in files if path not in paths]:
        warnings.warn(f"{place}: {len(others)} other files are left out, as {others[0]!r}", stacklevel=2)
    return sorted(paths, key=lambda path: [part.zfill(20) for part in re.split(r"(\d+)", path.name)])


def added(root: Path, name: str) -> list[str]:
    """Which photographs were not there when ``ctm cameras`` searched for the cameras of ``root``."""
    there = searched_in(root / MODEL)
    return [path.name for path in list_photographs(root, name) if path.name not in there] if there else []


def too_few(root: Path, place: Path, files: Sequence[Path], count: int) -> DataError:
    """Say why a folder ``place`` of ``root`` has too few pictures, and the command that puts some there."""
    target = shlex.quote(str(place))
    beside = sorted(path for path in root.iterdir() if path.is_file())
    video = next((path for path in (*files, *beside) if path.suffix.lower() in VIDEOS), None)
    inner = sorted({path.parent.name for path in place.glob("*/*") if is_picture(path)})
    if video:
        return video_found(video, place)
    if inner:
        one = f"ctm cameras {target} pictures={shlex.quote(inner[0])} takes one folder"
        return DataError(
            place, f"pictures in folders of it ({', '.join(inner)})", f"pictures of one lens directly in it; {one}"
        )
    if not place.is_dir():
        there = ", ".join(sorted(path.name for path in root.iterdir() if path.is_dir())) or "no folders"
        return DataError(root, there, f"photographs in {place.name}; for others, ctm cameras FOLDER pictures=NAME")
    foreign = [path for path in files if path.suffix.lower() in FOREIGN]
    expected = f"at least {FEWEST} ending in {', '.join(IMAGE_SUFFIXES)}"
    if foreign:
        expected += f"; {others_hint(foreign)}"
    return DataError(place, f"{count} pictures", expected)


def video_found(video: Path, place: Path) -> DataError:
    """Say how the pictures of a video get into a folder."""
    target = shlex.quote(str(place))
    taken = f"ffmpeg -i {shlex.quote(str(video))} -vf fps=2 -qscale:v 2 {target}/%04d.jpg"
    return DataError(video, "a video", f"its pictures: mkdir -p {target} && {taken}")
