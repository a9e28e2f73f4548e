"""Lenses by the focal lengths that fit pictures best; with COLMAP in test_find_cameras.py."""

import numpy as np
import pytest
import torch

from ctm_plugin.cameras.colmap import Features, Workshop
from ctm_plugin.cameras.lenses import lenses, with_focal_length
from ctm_plugin.data.readers.picture import Header

CHANCE = np.random.default_rng(0)


def around(length: float, spread: float, count: int) -> np.ndarray:
    return length * np.exp(spread * CHANCE.uniform(-1, 1, count))


@pytest.mark.parametrize(
    ("lengths", "counts"),
    [
        ([around(366, 0.01, 20), around(708, 0.03, 20)], [20, 20]),
        ([around(366, 0.01, 9), around(550, 0.01, 3), around(1400, 0.01, 4)], [9, 3, 4]),
        ([around(366, 0.02, 40)], [40]),
        ([around(380, 0.12, 40)], [40]),  # in much noise
        ([around(366, 0.01, 20), around(708, 0.01, 2)], [22]),  # two are too few
        ([around(366, 0.2, 20), around(708, 0.2, 20)], [40]),  # a gap, but no two lenses
        ([np.geomspace(300, 900, 12)], [12]),  # zoomed as one likes
        ([np.zeros(0)], [0]),
    ],
)
def test_lenses(lengths, counts):
    """However the pictures are ordered."""
    order = CHANCE.permutation(sum(counts))
    groups = lenses(np.concatenate(lengths)[order])
    assert [len(group) for group in groups] == counts
    assert sorted(np.concatenate(groups)) == [*range(sum(counts))]
    if len(counts) > 1:
        assert [sorted(order[group]) for group in groups] == [
            [*range(start, start + count)] for start, count in zip(np.cumsum([0, *counts]), counts, strict=False)
        ]


def test_a_search_that_was_stopped_begins_with_its_lenses_anew(tmp_path):
    """Another count of lenses may be found the next time."""
    headers = [Header(30, 40, alpha=False)] * 3
    places = np.ones((5, 4), np.float32)
    work = Workshop(tmp_path, 1, 0)
    work.store(headers, "PINHOLE", (Features(places, torch.empty(0)) for _ in headers))
    for focal in ([50.0, 50.0, 50.0], [50.0, 90.0, 90.0]):
        told = [with_focal_length(*each) for each in zip(headers, focal, strict=True)]
        again = work.with_headers(told, "PINHOLE", [])
        assert (again.stored(), again.details()) == (3, 15)
    assert work.stored() == 3
