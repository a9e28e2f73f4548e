"""Pictures in a capture's folder that are no photographs of it, by rule: copies, screenshots, panoramas."""

from __future__ import annotations

import hashlib
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

from ctm_plugin.data.readers.folders import PHONE_SUFFIXES, fold
from ctm_plugin.data.readers.images import read_picture
from ctm_plugin.errors import CTMError

SUFFIX_ORDER = (".exr", ".tif", ".tiff", *PHONE_SUFFIXES, ".png", ".webp", ".jpg", ".jpeg")
"""Suffixes in order of preference, where several files hold one photograph."""
PANORAMA_ASPECT = 2.0
"""Least ratio of longer to shorter side of a panorama, where the pictures next to it are none."""
PANORAMA_EXCESS = 1.4
"""Least ratio of a panorama's aspect to that of the pictures next to it."""
MAX_SCREENSHOTS = 0.25
"""Largest share of a folder's pictures that may be screenshots."""
DEVELOPED = "developed"
"""Name of the folder, next to raw pictures, that holds the developed ones."""
SCREENSHOT_NAME = re.compile(r"screen[ _-]?(shot|capture)|bildschirmfoto", re.IGNORECASE)
"""Pattern of the file names of screenshots."""


class Looks(NamedTuple):
    """Properties of a picture file that distinguish photographs from other pictures.

    Attributes:
        path: the file.
        sides: the picture's longer and shorter side in pixels.
        camera: whether EXIF names a camera.
    """

    path: Path
    sides: tuple[int, int]
    camera: bool

    @property
    def ratio(self) -> float:
        return self.sides[0] / self.sides[1]


def looks_of(path: Path) -> Looks | None:
    """Read a picture's header; ``None``: it cannot be read, which the later reading of the file reports."""
    try:
        header = read_picture(path).header
    except CTMError:
        return None
    return Looks(path, (max(header[:2]), min(header[:2])), bool(header.lens.maker or header.lens.model))


def left_out(paths: Sequence[Path]) -> dict[str, list[Path]]:
    """Find pictures to leave out of a capture, by kind.

    - copies: a file with the same bytes is there, or the same photograph under another suffix (``SUFFIX_ORDER``);
    - screenshots: called so, or by no camera and of a size that no photograph has, next to photographs by cameras;
    - panoramas: ``PANORAMA_ASPECT`` times as long as high, next to pictures that are not nearly.
    """
    pictures = [looks for path in paths if (looks := looks_of(path))]
    reasons: dict[str, list[Path]] = {}
    rules: tuple[tuple[str, Callable[[list[Looks]], Iterable[Path]]], ...]
    rules = (("copies", copies), ("screenshots", by_folder(screenshots)), ("panoramas", by_folder(panoramas)))
    for what, rule in rules:
        if hits := list(rule(pictures)):
            reasons[what] = hits
            pictures = [each for each in pictures if each.path not in hits]
    return reasons


def copies(pictures: Sequence[Looks]) -> list[Path]:
    """Copies: all but the first file of the same bytes, and all but one of the same name and shape in a folder."""
    sizes = Counter(each.path.stat().st_size for each in pictures)
    seen: set[bytes] = set()
    hits, names = [], defaultdict(list)
    for each in sorted(pictures, key=lambda each: len(str(each.path))):  # IMG_1.jpg goes before IMG_1 (1).jpg
        if sizes[each.path.stat().st_size] > 1:
            digest = hashlib.sha256(each.path.read_bytes()).digest()
            if digest in seen:
                hits.append(each.path)
                continue
            seen.add(digest)
        folder = each.path.parent.parent if each.path.parent.name == DEVELOPED else each.path.parent
        names[fold(str(folder / each.path.stem)), round(each.ratio, 1)].append(each.path)
    for alike in names.values():
        hits += sorted(alike, key=lambda path: SUFFIX_ORDER.index(path.suffix.lower()))[1:]
    return hits


def screenshots(pictures: Sequence[Looks]) -> list[Path]:
    """Screenshots, by name; also pictures without a camera, if they are few and of a size that no photograph has."""
    called = [each.path for each in pictures if SCREENSHOT_NAME.search(each.path.name)]
    sizes = {each.sides for each in pictures if each.camera}
    other = [each.path for each in pictures if sizes and not each.camera and each.sides not in sizes]
    few = len(other) < MAX_SCREENSHOTS * len(pictures)
    return [each.path for each in pictures if each.path in called or (few and each.path in other)]


def panoramas(pictures: Sequence[Looks]) -> list[Path]:
    usual = median(each.ratio for each in pictures)
    return [each.path for each in pictures if each.ratio >= max(PANORAMA_ASPECT, PANORAMA_EXCESS * usual)]


def by_folder(rule: Callable[[list[Looks]], list[Path]]) -> Callable[[list[Looks]], list[Path]]:
    """Turn a rule on one folder's pictures into a rule on several folders: a clip's frames are judged by themselves."""

    def of_all(pictures: Sequence[Looks]) -> list[Path]:
        folders = defaultdict(list)
        for each in pictures:
            folders[each.path.parent].append(each)
        return [path for within in folders.values() for path in rule(within)]

    return of_all
