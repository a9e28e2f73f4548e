"""Samples that are chosen, into as many places as they are or into a fixed number."""

import pytest
import torch

from ctm_plugin.rays import packing
from ctm_plugin.rays.packing import Packing, Places, fits, places_for

RAYS = torch.tensor([0, 0, 1, 1, 1, 3])
MASK = torch.tensor([True, False, True, True, False, True])


def test_as_many_as_are_chosen():
    found = Packing(4)
    index, rays = found.choose(MASK, RAYS)
    assert (index.tolist(), rays.tolist()) == ([0, 2, 3, 5], [0, 1, 1, 3])
    assert (found.counts, found.rays) == ([4], 4)
    weights = torch.ones(4)
    assert [each.tolist() for each in found.closed(weights, rays)] == [[1] * 4, [0, 1, 1, 3]]


@pytest.mark.parametrize("places", [3, 4, 5, 130])
def test_places_are_filled_in_order(places):
    found = Packing(4, [places])
    index, rays = found.choose(MASK, RAYS)
    there = min(places, 4)
    assert (len(index), index[:there].tolist(), rays[:there].tolist()) == (
        places,
        [0, 2, 3, 5][:there],
        [0, 1, 1, 3][:there],
    )
    assert found.counts[0] == 4
    assert (rays[there:] >= 4).all()
    assert (rays.diff() >= 0).all()
    assert rays.max() < found.rays
    assert rays[there:].bincount().max() <= packing.PLACES_PER_RAY if places > there else True
    weights, rays = found.closed(torch.ones(places), rays)
    assert weights.sum() == there
    assert rays.max() <= 3
    assert (rays.diff() >= 0).all()


def test_what_is_left_over_is_not_chosen_again():
    found = Packing(4, [100, 50])
    _, rays = found.choose(MASK, RAYS)
    _, rays = found.choose(torch.ones(100, dtype=torch.bool), rays)
    assert [int(count) for count in found.counts] == [4, 4]
    assert rays[:4].tolist() == [0, 1, 1, 3]
    sums = found.sums(torch.ones(50), rays)
    assert sums.tolist() == [1, 2, 0, 1]


def test_places_fall_and_have_some_to_spare():
    assert places_for([10000, 10000, 10000, 10]) == (13312, 13311, 13310, 1024)


@pytest.mark.parametrize(
    ("counts", "fit"), [([10000, 9000], True), ([13313, 9000], False), ([10000, 13312], False), ([5000, 5000], False)]
)
def test_what_fits(counts, fit):
    assert fits(counts, (13312, 13311)) == fit
    assert fits([1, 1], (1024, 1023))


def test_places_are_found_and_found_anew(monkeypatch):
    monkeypatch.setattr(packing, "STEPS_BETWEEN_CHECKS", 1)
    places, cpu = Places(), torch.device("cpu")
    for count in range(packing.COUNTED_STEPS):
        assert places.settle(0.1, cpu) is None
        places.watch([9000 + count, 5000])
    first = places.settle(0.1, cpu)
    assert places.found == places_for([9007, 5000])
    places.watch([torch.tensor(9100), torch.tensor(4000)])
    places.watch([torch.tensor(8000), torch.tensor(5100)])
    assert places.settle(0.1, cpu) == first
    places.watch([torch.tensor(90000), torch.tensor(5000)])
    assert places.settle(0.1, cpu) is None
    for _ in range(packing.COUNTED_STEPS):
        places.watch([90000, 5000])
    assert places.settle(0.1, cpu) != first
    assert places.settle(0.2, cpu) is None
