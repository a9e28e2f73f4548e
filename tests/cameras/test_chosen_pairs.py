"""Pairs of pictures by what they look like, and by their names."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from ctm_plugin.cameras.pairs import NEIGHBOURS, PARTNERS, all_pairs, likely_pairs, votes

SEEN = 40


def walked(count: int, noise: float = 0.3) -> list[torch.Tensor]:
    """Descriptions of what pictures along a way see: each the next things of a long row, in any order, in noise."""
    chance = torch.Generator().manual_seed(0)
    things = F.normalize(torch.randn(4 * count + SEEN, 32, generator=chance), dim=-1)
    looks = []
    for number in range(count):
        here = things[4 * number : 4 * number + SEEN][torch.randperm(SEEN, generator=chance)[: SEEN - number % 3]]
        looks.append(F.normalize(here + noise * torch.randn(here.shape, generator=chance) / 32**0.5, dim=-1))
    return looks


def test_all_pairs():
    assert all_pairs(3) == [(1, 2), (1, 3), (2, 3)]


@pytest.mark.parametrize("count", [3, 20, 40, 333])
def test_few_pairs_are_likely(count):
    """Each once, in order; the ring is closed; no more for a picture when there are more pictures."""
    pairs = likely_pairs(walked(count))
    assert pairs == sorted(set(pairs))
    assert all(1 <= first < second <= count for first, second in pairs)
    assert {(number, number + 1) for number in range(1, count)} | {(1, count)} <= set(pairs)
    assert len(pairs) <= count * (NEIGHBOURS + PARTNERS + np.log2(count))


def test_pictures_that_see_the_same_are_paired_whatever_their_names():
    """Two that see half of the same things are five apart on the way."""
    count = 60
    order = np.random.default_rng(0).permutation(count)
    looks = walked(count)
    pairs = set(likely_pairs([looks[place] for place in order]))
    at = np.argsort(order) + 1
    near = [tuple(sorted((at[place], at[place + 5]))) for place in range(count - 5)]
    assert np.mean([pair in pairs for pair in near]) > 0.9


def test_nobody_votes_for_itself():
    given = votes(walked(12))
    assert given.diagonal().sum() == 0
    assert given[0, 1] > given[0, 11]
    assert votes([*walked(3), torch.zeros(0, 32)]).shape == (4, 4)  # one picture is blank
