"""The verb ``cameras``: finds the cameras of photographs and writes them into the photographs' folder."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

from ctm_plugin import __version__
from ctm_plugin.cameras.clips import take_frames
from ctm_plugin.cameras.colmap import Reconstruction, require_pycolmap
from ctm_plugin.cameras.photographs import MODEL_FOLDER, added, home_of, list_photographs
from ctm_plugin.cameras.raws import develop_raws
from ctm_plugin.cameras.search import find_cameras
from ctm_plugin.cameras.settings import CamerasConfig
from ctm_plugin.cameras.trust import Trusted
from ctm_plugin.data.readers.colmap_model import mark_as_shown
from ctm_plugin.data.readers.folders import require_folder
from ctm_plugin.data.readers.images import read_picture
from ctm_plugin.errors import DataError
from ctm_plugin.files import replacing_folder
from ctm_plugin.show.console import output_console, print_next, table_for

FEW_OBSERVATIONS = 100
"""Observations a picture below which a model is warned of: with 49, cameras of a noisy capture were off by 4.8 % in the
median, 26 % at most, before they were refined."""
KEPT_FOLDER, KEY = ".ctm_cameras", "search.json"
"""Folder inside the capture for a stopped search's results, and the file in it that identifies the search."""
MAX_NAMES = 5
"""Most names of pictures in a message."""


def cameras(folder: Path, settings: CamerasConfig) -> None:
    """Find where photographs were taken from, with COLMAP on brightened copies, and write ``sparse/0`` next to them.

    FOLDER has the photographs in ``images``. They stay as they are; ``dataset=colmap`` reads the folder afterwards.
    Where lenses, by EXIF's focal lengths, or sizes differ, each has a camera of its own. FOLDER may be a clip, or hold
    some, see :func:`~ctm_plugin.cameras.clips.take_frames`.
    """
    root = take_frames(folder, settings.pictures)
    develop_raws(root)
    tell(root, *find_and_write(root, settings))
    print_next("photos", root)


def find_and_write(folder: Path, settings: CamerasConfig) -> tuple[list[str], Trusted, float]:
    """Find a capture's cameras and write COLMAP's model, see :func:`cameras`.

    Returns:
        The photographs' names, COLMAP's model, and the factor on their light that it was found with.
    """
    root = require_folder(folder, f"a folder with photographs in {settings.pictures}")
    paths = list_photographs(root, settings.pictures)
    pictures, home = [read_picture(path) for path in paths], home_of(root, settings.pictures)
    names = [path.relative_to(home).as_posix() for path in paths]
    for there in (root / MODEL_FOLDER, root / MODEL_FOLDER.parent / "cameras.bin"):
        if not settings.overwrite and (there.exists() or there.is_symlink()):
            more = added(root, settings.pictures)
            since = f", and {len(more)} photographs that were added since" if more else ""
            raise DataError(there, f"cameras that are there already{since}", "none, or overwrite=true to replace them")
    require_pycolmap()
    try:
        with (
            replacing_folder(root / MODEL_FOLDER) as target,
            kept(root / KEPT_FOLDER, key_of(paths, settings)) as folder,
        ):
            trusted, gain = find_cameras(pictures, names, settings, folder)
            trusted.model.extract_colors_for_all_images(home)
            trusted.model.write_binary(target)
            mark_as_shown(target, names)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("stopped; what was done is kept") from None
    except PermissionError as error:
        found = f"a folder that cannot be written to ({error.strerror})"
        raise DataError(root, found, "a copy of it: cameras are written next to the photographs") from error
    return names, trusted, gain


@contextmanager
def kept(folder: Path, key: str) -> Iterator[Path]:
    """Context with a folder for a search's results; it stays only if that is stopped, for one of the same ``key``."""
    if not (folder / KEY).is_file() or (folder / KEY).read_text("utf-8") != key:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        (folder / KEY).write_text(key, "utf-8")
    try:
        yield folder
    except Exception:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    shutil.rmtree(folder, ignore_errors=True)


def key_of(paths: Sequence[Path], settings: CamerasConfig) -> str:
    """Key that identifies a search: its photographs and its settings."""
    files = [[str(path), path.stat().st_size, path.stat().st_mtime_ns] for path in paths]
    return json.dumps([__version__, asdict(replace(settings, overwrite=False, threads=1)), files])


def tell(root: Path, names: Sequence[str], trusted: Trusted, gain: float) -> None:
    """Print a table of the search: pictures placed, points, reprojection error in pixels, focal lengths, gain.

    Then the pictures without a camera, and the model's folder.
    """
    model = trusted.model
    placed = {model.image(number).name for number in model.reg_image_ids()}
    console = output_console()
    table = table_for(console, show_header=False)
    table.add_row("pictures", f"{len(placed)} of {len(names)}")
    few = "" if trusted.mean >= FEW_OBSERVATIONS else ", few: places may be off by some percent"
    table.add_row("points", f"{model.num_points3D()}; a mean picture sees {trusted.mean:.0f} that two others see{few}")
    table.add_row("reprojection error", f"{model.compute_mean_reprojection_error():.2f} pixels (mean)")
    for text in focal_lengths(model):
        table.add_row("focal length", text)
    table.add_row("brightened", f"{gain:.1f} times" if gain > 1 else "not at all")
    console.print(table)
    if left := [name for name in names if name not in placed]:
        text = ", ".join(left[:MAX_NAMES]) + ", ..." * (len(left) > MAX_NAMES)
        console.print(f"not placed, and not trained on: {text}", soft_wrap=True, highlight=False, markup=False)
    console.print(f"written to {root / MODEL_FOLDER}", soft_wrap=True, highlight=False, markup=False)


def focal_lengths(model: Reconstruction) -> list[str]:
    """Word the focal length of each camera of a model; where there are several, with the number of its pictures."""
    counts = Counter(model.image(number).camera_id for number in model.reg_image_ids()).most_common()
    text = []
    for number, count in counts[:MAX_NAMES]:
        camera = model.cameras[number]
        whose = f", in {count} pictures" if len(counts) > 1 else ""
        text.append(f"{camera.mean_focal_length():.1f} pixels of {camera.width}x{camera.height}{whose}")
    return [*text, f"and {len(counts) - MAX_NAMES} others: lenses or sizes differ"] if len(counts) > MAX_NAMES else text
