"""Which pictures are compared: all with all where they are few, else those that look alike, and neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import torch
from jaxtyping import Float32, Int64
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

NEIGHBOURS = 3
"""Pictures on each side, by name, that each is compared with; then those 16, 32, 64, ... away."""
VOTERS, VOTES = 256, 8
"""Details of a picture that vote, and pictures that each votes for."""
PARTNERS = 15
"""Pictures that each is compared with for their votes."""


def all_pairs(count: int) -> list[tuple[int, int]]:
    """All pairs of ``count`` pictures, numbered from 1."""
    return list(combinations(range(1, count + 1), 2))


def likely_pairs(looks: Sequence[Float32[Tensor, "n d"]]) -> list[tuple[int, int]]:
    """Pairs of pictures that show the same thing, most likely: :func:`votes` for one another, or near by name.

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
    """How many details of a picture, the row, look more like one of another, the column, than like most pictures'."""
    padded = pad_sequence(list(looks), batch_first=True)
    given = torch.zeros(len(looks), len(looks), dtype=torch.long)
    for number, own in enumerate(looks):
        nearest = (own @ padded.flatten(0, 1).T).unflatten(1, padded.shape[:2]).amax(-1)
        nearest[:, number] = -1.0
        chosen = nearest.topk(min(VOTES, len(looks) - 1)).indices
        given[number] = torch.bincount(chosen.flatten(), minlength=len(looks))
    return given
