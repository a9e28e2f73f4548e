"""Hot pixels by closed forms: sensors whose every pixel is known."""

import numpy as np
import pytest

from ctm_plugin.data.readers.hot_pixels import around, hot_pixels, repair

SHAPE = (40, 52)
HOT = ((0, 0), (0, 51), (39, 20), (17, 1), (20, 30), (21, 30))
"""Corners, edges, and two of different colours next to one another."""


def mosaics(count: int = 8, noise: float = 3.0) -> np.ndarray:
    """Scenes that move by 3 columns, an edge as bright as a hot pixel in them, in each colour's own level."""
    rng = np.random.default_rng(0)
    row, column = np.indices(SHAPE)
    level = 100 + 40 * ((row % 2) + (column % 2))
    moved = [level + 200 * (((column + 3 * number) % 24) < 4) for number in range(count)]
    return (np.array(moved) + rng.normal(0, noise, (count, *SHAPE))).round().astype(np.uint16)


def test_the_median_of_four_neighbours_of_its_colour():
    mosaic = np.random.default_rng(1).integers(0, 2**16, (7, 10)).astype(np.uint16)
    padded = np.pad(mosaic.astype(float), 2, mode="reflect")
    four = (padded[:-4, 2:-2], padded[4:, 2:-2], padded[2:-2, :-4], padded[2:-2, 4:])
    found = around(mosaic, *np.indices(mosaic.shape, sparse=True))
    np.testing.assert_allclose(found, np.median(np.stack(four), 0), rtol=1e-6)


def test_what_stands_out_in_all_is_found_and_nothing_else():
    taken = mosaics()
    assert not hot_pixels(taken).any()
    for place in HOT:
        taken[:, *place] += 60
    np.testing.assert_array_equal(np.argwhere(hot_pixels(taken)), sorted(HOT))


@pytest.mark.parametrize(("times", "expected"), [(5, 0), (6, 1)])
def test_in_three_quarters_of_the_pictures(times, expected):
    taken = np.full((8, *SHAPE), 100, np.uint16)
    taken[:times, 10, 10] += 50
    assert hot_pixels(taken).sum() == expected


def test_only_hot_pixels_are_repaired():
    mosaic, hot = mosaics(1, noise=0)[0], np.zeros(SHAPE, bool)
    flat = mosaic.copy()
    hot[20, 30] = hot[0, 0] = True
    mosaic[hot] = 60000
    repair(mosaic, hot)
    np.testing.assert_array_equal(mosaic[~hot], flat[~hot])
    assert mosaic[20, 30] == np.median([flat[18, 30], flat[22, 30], flat[20, 28], flat[20, 32]])
