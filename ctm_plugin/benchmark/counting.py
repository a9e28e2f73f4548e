"""FLOPs and bytes of what torch does inside a block, counted operator by operator."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from ctm_plugin.cpu.door import listeners

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

    def loop(self, moved: int, flops: int) -> None:
        self.bytes += moved
        self.flops += flops

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


def _size(tensor: Tensor) -> int:
    """Bytes behind a tensor: of an expanded or a sparse one, those that are there."""
    if tensor.is_sparse:
        return _size(tensor._indices()) + _size(tensor._values())
    return min(tensor.numel() * tensor.element_size(), tensor.untyped_storage().nbytes())
