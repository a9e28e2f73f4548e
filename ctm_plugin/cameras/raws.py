"""Development of a capture's raw pictures, all alike, into a folder of its photographs."""

from __future__ import annotations

import warnings
from pathlib import Path
from statistics import median_low

import numpy as np
import tifffile

from ctm_plugin.cameras.left_out import DEVELOPED
from ctm_plugin.cameras.photographs import below
from ctm_plugin.data.readers.folders import RAW_SUFFIXES
from ctm_plugin.data.readers.images import read_picture
from ctm_plugin.data.readers.raw import RawHeader, open_raw, read_raw
from ctm_plugin.errors import DataError
from ctm_plugin.files import replacing
from ctm_plugin.show.bars import bar

HALF_SIZE_SIDE = 3000
"""Longer side in pixels from which a raw picture is developed at half its size."""


def develop_raws(root: Path) -> None:
    """Develop the raw pictures in a folder and below it to TIFF of 16 bits, and print how many.

    All get the white balance of the picture with the median ratio of red to blue. Where exposures differ, shorter ones
    are brightened to the level of the longest. All are developed anew unless all developed files exist.

    Raises:
        DataError: no picture can be developed.
    """
    targets = {path: path.parent / DEVELOPED / f"{path.stem}.tif" for path in below(root) if is_raw(path)}
    if not targets:
        return
    folders = ", ".join(str(folder) for folder in dict.fromkeys(target.parent for target in targets.values()))
    headers: dict[Path, RawHeader] = {}
    faults: list[DataError] = []
    for path in targets:
        try:
            headers[path] = read_raw(path)
        except DataError as error:
            faults.append(error)
    if not headers:
        raise faults[0]
    for fault in faults:
        warnings.warn(f"{fault}; it is left out", stacklevel=2)
    if all(targets[path].exists() for path in headers):
        print(f"{len(headers)} pictures in {folders} are used, developed before")
        return
    exposures = [header.exposure for header in headers.values()]
    known = None not in exposures
    redness = {path: header.balance[0] / max(header.balance[2], 1e-6) for path, header in headers.items()}
    middle = median_low(redness.values())
    balance = next(headers[path].balance for path, ratio in redness.items() if ratio == middle)
    with bar("developed", len(headers)) as done:
        for number, (path, header) in enumerate(headers.items(), 1):
            brightness = max(exposures) / header.exposure if known else 1.0
            _develop(path, targets[path], header, brightness, balance)
            done(number, path.name)
    evened = f", exposures evened by up to {max(exposures) / min(exposures):.3g} times" if known else ""
    print(f"{len(headers)} raw pictures developed with one white balance{evened}: {folders}")


def is_raw(path: Path) -> bool:
    """Tell whether a file is a raw picture by its name."""
    return path.suffix.lower() in RAW_SUFFIXES


def _develop(path: Path, target: Path, header: RawHeader, brightness: float, balance: tuple[float, ...]) -> None:
    def decode(path: Path) -> object:
        return open_raw(path, brightness, balance, header.side > HALF_SIZE_SIDE)

    codes = read_picture(path, decode).image().numpy()
    turned = [(274, "H", 1, header.orientation, True)]
    target.parent.mkdir(exist_ok=True)
    with replacing(target) as beside:
        tifffile.imwrite(beside, (codes * 65535).round().astype(np.uint16), photometric="rgb", extratags=turned)
