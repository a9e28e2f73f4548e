"""FLOPs and bytes of what torch does inside a block, counted operator by operator."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from ctm_plugin.cpu.compiled import listeners
from ctm_plugin.cpu.lookup import BLOCK

_ALLOCATE = ("empty", "new_empty", "empty_like", "empty_strided", "new_empty_strided")
_BY_ROW = (
    "index",
    "index_select",
    "gather",
    "embedding",
    "_embedding_bag",
    "_embedding_bag_forward_only",
    "index_add_",
)
"""Operators that touch the rows of their table that they are given indices of, not all of it."""


@dataclass
class Counts:
    """Of one block.

    Attributes:
        flops: of products of matrices; other arithmetic is not counted.
        bytes: that operators read and wrote, as if nothing stayed in a cache; 0 until the block has ended.
    """

    flops: int = 0
    bytes: int = 0


@contextmanager
def counted() -> Iterator[Counts]:
    """Count all that runs inside, backward passes included.

    Example:
        >>> with counted() as counts:
        ...     _ = torch.ones(2, 3) @ torch.ones(3, 4)
        >>> counts.flops
        48
    """
    counts = Counts()
    with FlopCounterMode(display=False) as flops, _CountBytes() as moved:
        listeners.append(moved.loop)
        try:
            yield counts
        finally:
            listeners.remove(moved.loop)
    counts.flops, counts.bytes = flops.get_total_flops() + moved.flops, moved.bytes


class _CountBytes(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.bytes = self.flops = 0

    def loop(self, name: str, arguments: tuple) -> None:
        self.bytes += _moved_by_loop(name, arguments)
        self.flops += _products_of_loop(name, arguments)

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        out = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        if not func.is_view and name not in _ALLOCATE:
            self.bytes += _moved(name, [args, kwargs or {}], out)
        return out


def _moved(name: str, given: Any, out: Any) -> int:
    read = [leaf for leaf in tree_leaves(given) if isinstance(leaf, Tensor)]
    written = [leaf for leaf in tree_leaves(out) if isinstance(leaf, Tensor)]
    if name not in _BY_ROW or not read:
        return sum(map(_size, [*read, *written]))
    table, *rest = read
    rows = sum(leaf.numel() for leaf in rest if not leaf.is_floating_point())
    touched = min(_size(table), rows * _size(table) // max(1, len(table)))
    if name == "index_add_":  # read and written, in place
        return 2 * touched + sum(map(_size, rest))
    return touched + sum(map(_size, [*rest, *written]))


def _moved_by_loop(name: str, arguments: tuple) -> int:
    """Of a loop of :mod:`ctm_plugin.cpu`: each array once, except where rows of a table are looked up."""
    if name == "_losses":
        return sum(each.nbytes for each in arguments if isinstance(each, Tensor | np.ndarray))
    tensors = [each for each in arguments if isinstance(each, Tensor)]
    if name == "adam_rows":  # three tables, of which the gradient's rows are read and written
        *tables, rows, grad, rates, _ = tensors
        return _size(rows) + (1 + 2 * len(tables)) * _size(grad) + min(_size(rates), _size(grad))
    if name == "_touched":  # flags are set and gone through twice, in blocks; an index is written where one is set
        rows, touched, _ = tensors
        return 2 * _size(rows) + 2 * min(_size(touched), BLOCK * rows.numel())
    if name in ("count_occupied", "fill_occupied"):  # of the occupancy what samples are near
        occupancy, samples = tensors[4], int(tensors[3].sum())
        return sum(map(_size, tensors)) - _size(occupancy) + min(_size(occupancy), samples)
    if name == "_numbers_at":
        return sum(map(_size, tensors[1:])) + tensors[1].numel() * tensors[0].element_size()
    if name in ("_add", "_add_numbers"):  # for each corner a row of the sums is read and written
        rows, weights, grad, index, _ = tensors
        return _size(rows) * (2 if len(index) else 1) + _size(weights) + (1 + 2 * rows.shape[1]) * _size(grad)
    return sum(map(_size, tensors))


def _products_of_loop(name: str, arguments: tuple) -> int:
    """FLOPs of products in a loop: CTM's alone has some."""
    if name != "_losses":
        return 0
    _, rgb, random, random_latent, latents, _, _, sizes, _, factors, *_ = arguments
    products = [[int(inner * outer) for inner, outer in pairwise(each)] for each in sizes]
    encoder, decoder = ([3 * sum(each) - each[0], 3 * sum(each)] for each in products)  # without and with the inputs'
    decoded = len(rgb) * (bool(factors[2]) + len(latents) * bool(factors[1]))
    first = len(rgb) * encoder[0] + decoded * decoder[1]
    return 2 * (first + len(random) * (encoder[0] + decoder[1]) + len(random_latent) * (decoder[0] + encoder[1]))


def _size(tensor: Tensor) -> int:
    """Bytes behind a tensor: of an expanded or a sparse one, those that are there."""
    if tensor.is_sparse:
        return _size(tensor._indices()) + _size(tensor._values())
    return min(tensor.numel() * tensor.element_size(), tensor.untyped_storage().nbytes())
