"""Frames of clips, written into the folder of a capture's photographs."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from ctm_plugin.cameras.photographs import PICTURE_SUFFIXES, below, home_of
from ctm_plugin.data.readers.clip import CLIP_SUFFIXES, HDR_CURVES, read_clip, watched, write_frames
from ctm_plugin.data.readers.folders import fold, is_picture, require_folder
from ctm_plugin.errors import DataError
from ctm_plugin.files import replacing_folder
from ctm_plugin.show.bars import bar

STILL_CLIP = "a clip in which next to nothing moves", "one that goes around or past what it shows"
"""Pair of found and expected, for the error that a clip hardly moves."""


def is_clip(path: Path) -> bool:
    """Tell whether a file is a video clip, by its suffix; hidden files are not."""
    return path.suffix.lower() in CLIP_SUFFIXES and not path.name.startswith(".")


def root_of(given: Path) -> Path:
    """Find a capture's folder: the given folder itself, or the folder of a given clip's frames, next to the clip."""
    return given.with_suffix("") if is_clip(given) and given.is_file() else given


def take_frames(given: Path, pictures: str) -> Path:
    """Write the sharpest frames of a clip, or of all clips in a folder, as photographs; print how many.

    Frames of ``NAME.mp4`` go to the folder ``NAME/images``, of clips in a folder to ``NAME`` among its photographs.
    Frames written earlier are used; clips that came with a still, as Live Photos do, are left out.

    Args:
        given: a folder or a clip.
        pictures: the folder in it for photographs.

    Returns:
        The folder of the capture, see :func:`root_of`.

    Raises:
        DataError: a clip cannot be used, and there are no photographs besides.
    """
    root = root_of(given)
    folders = {given: root / pictures} if root != given else folders_of_clips(given, pictures)
    there = {clip: sum(map(is_picture, folder.glob("*"))) for clip, folder in folders.items()}
    for clip, count in there.items():
        if count:
            newer = clip.stat().st_mtime > folders[clip].stat().st_mtime
            more = "; the clip is newer: remove them to take others" if newer else ""
            print(f"{clip.name}: its {count} frames in {folders[clip]} are used{more}")
    missing = [clip for clip, count in there.items() if not count]
    if missing:
        from ctm_plugin.data.clip_frames import choose, course  # half a second, which photographs do not need

        faults: list[DataError] = []
        courses = {}
        for clip in missing:
            try:
                courses[clip] = course(_seen(clip))
            except DataError as error:
                faults.append(error)
        for (clip, each), numbers in zip(courses.items(), choose([*courses.values()]), strict=True):
            if numbers:
                _write(clip, numbers, len(each.moved), folders[clip])
            else:
                faults.append(DataError(clip, *STILL_CLIP))
        if faults and not any(map(is_picture, below(root))):
            raise faults[0]
        for fault in faults:
            warnings.warn(f"{fault}; it is left out", stacklevel=2)
    return root


def folders_of_clips(given: Path, pictures: str) -> dict[Path, Path]:
    """Map the clips in a folder, and in folders below it, to a folder for the frames of each."""
    root = require_folder(given, "a folder with photographs or clips, or a clip")
    files = below(root)
    stills = {fold(str(path.with_suffix(""))) for path in files if path.suffix.lower() in PICTURE_SUFFIXES}
    clips = [path for path in files if is_clip(path)]
    live = [path for path in clips if fold(str(path.with_suffix(""))) in stills]
    if live:
        line = f"clips with a still of the same name left out: {len(live)}, as {live[0].name!r}"
        warnings.warn(f"{root}: {line}: Live Photos", stacklevel=3)
    folders: dict[Path, Path] = {}
    home = home_of(root, pictures)
    for clip in (path for path in clips if path not in live):
        folder = home / clip.stem
        folders[clip] = folder if folder not in folders.values() else home / clip.name.replace(".", "_")
    return folders


def _seen(clip: Path) -> Iterator[Float32[np.ndarray, "h w"]]:
    with bar(clip.name, read_clip(clip).count) as done:
        for number, frame in enumerate(watched(clip), 1):
            done(number)
            yield frame


def _write(clip: Path, numbers: list[int], count: int, folder: Path) -> None:
    try:
        with replacing_folder(folder) as fresh, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they were given when it was watched
            header = write_frames(clip, numbers, fresh)
    except PermissionError as error:
        found = f"a folder that cannot be written to ({error.strerror})"
        raise DataError(folder.parent, found, f"a copy of {clip.name} in another: frames are written there") from error
    turned = f", {HDR_CURVES[header.curve]} turned to sRGB" if header.curve else ""
    print(f"{clip.name}: {len(numbers)} of {count} frames, the sharpest on each stretch of the way{turned}: {folder}")
