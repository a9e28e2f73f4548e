"""Finding a data set's pictures, by folder or by the names in its files, and their masks."""

from __future__ import annotations

import glob
import warnings
from collections.abc import Sequence
from pathlib import Path, PurePath, PurePosixPath

import numpy as np

from ctm_plugin.data.readers.folders import (
    IMAGE_SUFFIXES,
    RAW_HINT,
    RAW_SUFFIXES,
    fold,
    folded,
    inside,
    is_picture,
    look_for,
    others_hint,
    plain_name,
)
from ctm_plugin.errors import DataError

MIN_PHOTOGRAPHS = 3
"""Least number of photographs of a scene."""
MASK_FOLDERS = ("mask", "image_masks", "images_mask", "images_masks")
"""Other programs' names of the folder ``masks``."""


def list_pictures(root: Path, folder: Path) -> list[Path]:
    """The pictures in a folder of the data set's, in the order of their names; DataError: there are none."""
    names = sorted(path.name for path in folder.iterdir() if is_picture(path))
    if not names:
        there = sorted(folder.iterdir())
        raw = any(path.suffix.lower() in RAW_SUFFIXES for path in there)
        expected = f"files ending in {', '.join(IMAGE_SUFFIXES)}; {RAW_HINT if raw else others_hint(there)}"
        raise DataError(folder, "no pictures", expected)
    return [inside(root, f"{folder.name}/{name}") for name in names]


def find_pictures(root: Path, whole_factor: int, factor: int | None = None) -> tuple[Path, bool]:
    """Find the pictures' folder: ``images_<whole_factor>``, else ``images``; with ``factor`` ``images_<factor>``.

    The second result is whether its pictures have been shrunk by ``dataset.downscale`` already.
    DataError: no such folder.
    """
    if factor is None and has_shrunk(root, whole_factor):
        return root / f"images_{whole_factor}", True
    chosen = root / (f"images_{factor}" if factor and factor > 1 else "images")
    if not chosen.is_dir():
        there = sorted(path.name for path in root.glob("images*") if path.is_dir())
        if factor is None and whole_factor == 1 and len(there) == 1:
            return root / there[0], False
        found = f"only {', '.join(there)}" if there else "no folder of pictures"
        wanted = "images, or dataset.downscale=N for images_N that is there"
        raise DataError(root, found, wanted if factor is None else f"{chosen.name} (dataset.factor={factor})")
    return chosen, False


def has_shrunk(root: Path, whole_factor: int) -> bool:
    """Whether ``images_<whole_factor>`` holds all pictures; if it holds fewer than ``images``, a warning says so."""
    ready, whole = root / f"images_{whole_factor}", root / "images"
    if whole_factor == 1 or not ready.is_dir():
        return False
    count, wanted = (sum(map(is_picture, each.rglob("*"))) for each in (ready, whole))
    if count < wanted:
        warnings.warn(f"{ready} holds {count} of {wanted} pictures: {whole} is taken and shrunk", stacklevel=2)
    return count >= wanted


def masks_beside(root: Path, names: Sequence[PurePath]) -> list[Path | None]:
    """Find masks: ``masks/NAME.EXT.png``, COLMAP's, ``NAME.png`` or ``NAME_mask.png``, in any case, of any kind.

    Names are those in the pictures' own folder; pictures without a mask count whole, with one warning;
    a DataError where none has one.
    """
    folder = folded(root).get("masks")
    if folder is None or not folder.is_dir():
        for other in (folded(root).get(name) for name in MASK_FOLDERS):
            if other is not None and other.is_dir():
                warnings.warn(f"{other}: not looked at; masks are to lie in {root / 'masks'}", stacklevel=2)
        return [None] * len(names)
    there = sorted(path.relative_to(folder) for path in folder.rglob("*") if is_picture(path))
    stems = {fold(str(path.with_suffix(""))): folder / path for path in there}

    def mask(name: PurePath) -> Path | None:
        stem = name.with_suffix("")
        return next((stems[key] for each in (name, stem, f"{stem}_mask") if (key := fold(str(each))) in stems), None)

    masks = [mask(name) for name in names]
    missing = [name.name for name, path in zip(names, masks, strict=True) if path is None]
    if len(missing) == len(names):
        lies = f"; {', '.join(map(str, there[:3]))} lie there" if there else ""
        expected = f"{missing[0]}.png and so on, or no folder masks"
        raise DataError(folder, f"no mask of any picture{lies}", expected)
    if missing:
        text = f"all pixels count of {len(missing)} of {len(names)} pictures, which have no mask, such as {missing[0]}"
        warnings.warn(f"{folder}: {text}", stacklevel=2)
    return masks


def find_listed(root: Path, name: str, source: Path) -> Path | None:
    """The picture that ``source`` calls ``name``, also with another suffix; ``None`` where there is none.

    Files in formats that are read here go before others: ``a.jpg`` before ``a.BMP``. DataError: only a raw picture.
    """
    path = PurePosixPath(plain_name(name))
    file = look_for(root, name, source)
    if file is None or file.suffix.lower() not in IMAGE_SUFFIXES:
        developed = look_for(root, str(path.parent / path.stem), source)
        if file is not None and developed is None and file.suffix.lower() in RAW_SUFFIXES:
            raise DataError(file, "a raw picture", RAW_HINT)
        return developed or file
    return file


def existing(root: Path, paths: Sequence[Path | None], names: Sequence[str], source: Path) -> list[int]:
    """Indices of the listed pictures whose files exist; one warning counts the others by their names in ``source``.

    Raises a DataError for fewer than ``MIN_PHOTOGRAPHS``.
    """
    missing = [name for path, name in zip(paths, names, strict=True) if path is None]
    left = len(names) - len(missing)
    if left < MIN_PHOTOGRAPHS:
        what, expected = f"{left} pictures", f"at least {MIN_PHOTOGRAPHS} whose files exist"
        if missing:
            what += f"; {len(missing)} that it lists are missing, such as {missing[0]!r}"
            path = PurePosixPath(plain_name(missing[0]))
            homes = sorted(each.parent.name for each in root.glob(f"*/{glob.escape(path.stem)}.*"))
            if any(root.glob(f"{glob.escape(path.stem)}.*")):
                expected += f": {path.name} lies next to {source.name}, not in {path.parent}"
            expected += f": {path.name} lies in {' and '.join(homes)}" if homes else ""
            if homes and path.parts[0] == "images" and homes[0].startswith("images_"):
                expected += f", which is dataset.downscale={homes[0].removeprefix('images_')}"
        raise DataError(source, what, expected)
    if missing:
        message = f"{source}: {len(missing)} of {len(names)} pictures are missing and left out, such as {missing[0]!r}"
        warnings.warn(message, stacklevel=2)
    return [number for number, path in enumerate(paths) if path is not None]


def every_nth(step: int, count: int) -> np.ndarray:
    """Booleans ``[count]``, true at each index divisible by ``step``."""
    return np.arange(count) % step == 0
