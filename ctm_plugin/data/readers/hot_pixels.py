"""Hot pixels of a sensor: found across its pictures, where they stand out at one place, and repaired in each."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt16

MIN_SHARE = 0.75
"""Share of the pictures in which a hot pixel stands out: what is in the scene moves over the sensor."""
DEVIATIONS = 5
"""By how many standard deviations of one picture's noise it stands out, at least."""
THINNING = 7
"""Rows and columns from one pixel to the next of those that tell the noise; odd, so that all colours do."""


def hot_pixels(mosaics: Iterable[UInt16[np.ndarray, "h w"]]) -> Bool[np.ndarray, "h w"]:
    """Find the pixels ``[H, W]`` of a Bayer sensor that are brighter than those around them in nearly all its pictures.

    ``v - m``, with ``m`` the median of the four next ones of its colour, is above ``DEVIATIONS`` times the picture's
    noise, ``1.4826`` times the median of all ``|v - m|``, in ``MIN_SHARE`` of the pictures.
    """
    times, count = np.zeros((), np.int32), 0
    for mosaic in mosaics:
        excess = mosaic - around(mosaic, *np.indices(mosaic.shape, sparse=True))
        noise = 1.4826 * float(np.median(np.abs(excess[::THINNING, ::THINNING])))
        times = times + (excess > DEVIATIONS * max(noise, 1.0))  # whole numbers have a noise of their own
        count += 1
    return times >= MIN_SHARE * count


def repair(mosaic: UInt16[np.ndarray, "h w"], hot: Bool[np.ndarray, "h w"]) -> None:
    """Put what is around them into a Bayer mosaic's hot pixels, in place."""
    rows, columns = hot.nonzero()
    mosaic[rows, columns] = around(mosaic, rows, columns).round().astype(mosaic.dtype)


def around(
    mosaic: UInt16[np.ndarray, "h w"], rows: Int64[np.ndarray, "*n"], columns: Int64[np.ndarray, "*m"]
) -> Float32[np.ndarray, "*k"]:
    """The median of the four next pixels of one's colour, mirrored at the edges, for each row and column."""
    height, width = mosaic.shape
    up, left = np.abs(rows - 2), np.abs(columns - 2)
    down, right = height - 1 - np.abs(height - 3 - rows), width - 1 - np.abs(width - 3 - columns)
    places = ((up, columns), (down, columns), (rows, left), (rows, right))
    first, second, third, fourth = (mosaic[place].astype(np.float32) for place in places)
    low, high = np.minimum(first, second), np.maximum(first, second)
    return 0.5 * (np.maximum(low, np.minimum(third, fourth)) + np.minimum(high, np.maximum(third, fourth)))
