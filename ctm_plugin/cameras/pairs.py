"""Choice of the pairs of pictures to match: all pairs of few pictures, else pairs that look alike, and neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import torch
from jaxtyping import Float32, Int64
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

NEIGHBOURS = 3
"""Pictures on each side, by name, that a picture is matched with; further ones are 16, 32, 64, ... away."""
VOTERS, VOTES = 256, 8
"""Keypoints of a picture that vote for similar pictures, and pictures that each keypoint votes for."""
PARTNERS = 15
"""Number of pictures with most votes that each picture is matched with."""


def all_pairs(count: int) -> list[tuple[int, int]]:
    """All pairs of ``count`` pictures, numbered from 1."""
    return list(combinations(range(1, count + 1), 2))


def likely_pairs(looks: Sequence[Float32[Tensor, "n d"]]) -> list[tuple[int, int]]:
    """Choose pairs of pictures that probably show the same thing: ``PARTNERS`` each by :func:`votes`, or near by name.

    The ring of names closes captures that go round; steps that double tie passes that lie far apart by name.

    Args:
        looks: descriptions of length 1 of a few details of each picture, which are numbered from 1.
    """
    count = len(looks)
    steps = [*range(1, NEIGHBOURS + 1), *(2**power for power in range(4, count.bit_length()) if 2**power < count)]
    pairs = {tuple(sorted((first, (first + step) % count))) for step in steps for first in range(count)}
    given = votes(looks)
    best = (given + given.T).topk(min(PARTNERS, count - 1)).indices.tolist()
    pairs |= {tuple(sorted((first, second))) for first, others in enumerate(best) for second in others}
    return [(first + 1, second + 1) for first, second in sorted(pairs) if first != second]


@torch.inference_mode()
def votes(looks: Sequence[Float32[Tensor, "n d"]]) -> Int64[Tensor, "v v"]:
    """Votes ``[V, V]``: keypoints of picture i, the row, that resemble one of picture j more than most pictures'."""
    padded = pad_sequence(list(looks), batch_first=True)
    given = torch.zeros(len(looks), len(looks), dtype=torch.long)
    for number, own in enumerate(looks):
        nearest = (own @ padded.flatten(0, 1).T).unflatten(1, padded.shape[:2]).amax(-1)
        nearest[:, number] = -1.0
        chosen = nearest.topk(min(VOTES, len(looks) - 1)).indices
        given[number] = torch.bincount(chosen.flatten(), minlength=len(looks))
    return given
