"""Development of a capture's raw pictures, all alike, into a folder of its photographs."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from statistics import median_low

import numpy as np
from jaxtyping import Bool

from ctm_plugin.cameras.left_out import DEVELOPED
from ctm_plugin.cameras.photographs import below
from ctm_plugin.data.readers.deep import write_tiff
from ctm_plugin.data.readers.folders import RAW_SUFFIXES
from ctm_plugin.data.readers.hot_pixels import hot_pixels
from ctm_plugin.data.readers.images import read_image
from ctm_plugin.data.readers.raw import RawHeader, open_raw, read_mosaic, read_raw
from ctm_plugin.errors import DataError
from ctm_plugin.files import replacing
from ctm_plugin.show.bars import bar

HALF_SIZE_SIDE = 3000
"""Longer side in pixels from which a raw picture is developed at half its size."""
LEAST_OF_A_SENSOR, MOST_OF_A_SENSOR = 5, 12
"""Pictures of a sensor that its hot pixels are looked for in, at least and at most."""


def develop_raws(root: Path) -> None:
    """Develop the raw pictures in a folder and below it to TIFF of 16 bits, and print how many.

    All get the white balance of the picture with the median ratio of red to blue. Where exposures differ, shorter ones
    are brightened to the level of the longest. Pixels that are hot in all pictures of a sensor are repaired. All are
    developed anew unless all developed files exist.

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
    hot = find_hot(headers)
    with bar("developed", len(headers)) as done:
        for number, (path, header) in enumerate(headers.items(), 1):
            brightness = max(exposures) / header.exposure if known else 1.0
            _develop(path, targets[path], header, brightness, balance, hot[sensor_of(header)])
            done(number, path.name)
    spread = max(exposures) / min(exposures) if known else 1.0
    evened = f", exposures evened by up to {spread:.3g} times" if spread > 1.01 else ""
    count = sum(int(each.sum()) for each in hot.values() if each is not None)
    repaired = f", {count} hot pixels repaired" if count else ""
    print(f"{len(headers)} raw pictures developed with one white balance{evened}{repaired}: {folders}")


def is_raw(path: Path) -> bool:
    """Tell whether a file is a raw picture by its name."""
    return path.suffix.lower() in RAW_SUFFIXES


def sensor_of(header: RawHeader) -> tuple[object, ...]:
    """What pictures of one sensor share."""
    return header.lens.maker, header.lens.model, header.sensor


def find_hot(headers: Mapping[Path, RawHeader]) -> dict[tuple[object, ...], Bool[np.ndarray, "h w"] | None]:
    """Each sensor's hot pixels, by at most ``MOST_OF_A_SENSOR`` of its pictures.

    ``None``: there are fewer than ``LEAST_OF_A_SENSOR``, or it has no Bayer pattern.
    """
    sensors = defaultdict(list)
    for path, header in headers.items():
        sensors[sensor_of(header)].append(path)
    hot = {}
    for sensor, paths in sensors.items():
        chosen = paths[:: -(-len(paths) // MOST_OF_A_SENSOR)]
        mosaics = map(read_mosaic, chosen if len(chosen) >= LEAST_OF_A_SENSOR else ())
        first = next(mosaics, None)
        hot[sensor] = None if first is None else hot_pixels(chain([first], mosaics))
    return hot


def _develop(
    path: Path, target: Path, header: RawHeader, brightness: float, balance: tuple[float, ...],
    hot: Bool[np.ndarray, "h w"] | None,
) -> None:  # fmt: skip
    def decode(path: Path) -> object:
        return open_raw(path, brightness, balance, max(header.sensor) > HALF_SIZE_SIDE, hot)

    codes = read_image(path, decode).numpy()
    target.parent.mkdir(exist_ok=True)
    with replacing(target) as beside:
        write_tiff(beside, (codes * 65535).round().astype(np.uint16), header.orientation, header.lens)
