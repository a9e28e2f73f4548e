"""Torch's sums in another order, on purpose; imported where ``CTM_REORDERED`` is set, by ``conftest.py`` and by most of
the processes that tests start.

Operators of the CPU that add up get what they add up in an order that is drawn from their name, the sizes of what they
are given, and the variable. So a call that is repeated gives the same bits, as on any machine, while other batches,
chunks, shares of processes and ways to write a product add up in orders of their own: in every thread and type,
backwards as forwards.

The loops of the package stay as they are: they promise their order, and other instructions are other settings'.
"""

from __future__ import annotations

import functools
import os
import warnings
import zlib
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

NAME = "CTM_REORDERED"
KEPT = torch.library.Library("aten", "IMPL")
"""Without it operators would be as they were."""


@functools.lru_cache(1000)
def order(count: int, *of: Any) -> Tensor:
    """A permutation ``[count]``, always the same for the same ``of``."""
    seed = zlib.crc32(repr((os.environ.get(NAME), count, of)).encode())
    return torch.randperm(count, generator=torch.Generator().manual_seed(seed))


def product(run: Callable, name: str, *args: Any, **more: Any) -> Any:
    """The inner side of a product of two arguments; three where something is added.

    Another order where ``fast_products`` takes another library, which other machines may do.
    """
    *added, a, b = args[: 3 if name.startswith(("add", "badd")) else 2]
    at = order(a.shape[-1], name, a.shape, b.shape, torch.get_float32_matmul_precision())
    a, b = a.index_select(-1, at), b.index_select(-min(b.dim(), 2), at)
    return run(*added, a, b, *args[len(added) + 2 :], **more)


def reduction(run: Callable, name: str, summed: Tensor, *args: Any, **more: Any) -> Any:
    """The sides that are named, all where none is."""
    sides = args[1 if name == "linalg_vector_norm" else 0 :][:1] or [None]
    for side in sides[0] or range(summed.dim()) if summed.is_floating_point() and summed.dim() else ():
        summed = summed.index_select(side, order(summed.shape[side], name, summed.shape, side))
    return run(summed, *args, **more)


def running(run: Callable, name: str, summed: Tensor, side: int, **more: Any) -> Tensor:
    """The sums of two parts, as if two threads had them; the second goes on where the first ends."""
    if not summed.is_floating_point() or not summed.dim() or summed.shape[side] < 2:
        return run(summed, side, **more)
    first = 1 + int(order(summed.shape[side] - 1, name, summed.shape)[0])
    one, two = (run(part, side, **more) for part in summed.tensor_split([first], side))
    return torch.cat([one, two + one.narrow(side, -1, 1)], side)


def rows(run: Callable, name: str, to: Tensor, side: int, index: Tensor, source: Tensor, **more: Any) -> Tensor:
    """What goes to the places that an index names."""
    if index.dim() and source.dim():
        along = side if index.dim() > 1 else 0
        at = order(index.shape[along], name, to.shape, source.shape)
        index, source = index.index_select(along, at), source.index_select(side, at)
    return run(to, side, index, source, **more)


def placed(run: Callable, name: str, to: Tensor, indices: list, values: Tensor, *args: Any, **more: Any) -> Tensor:
    """What goes to rows, as the gradient of ``x[rows]`` does."""
    (index, *others), accumulate = indices, args[:1] == (True,) or more.get("accumulate")
    if accumulate and not others and index.dim() == 1 and index.dtype == torch.long and values.shape[:1] == index.shape:
        at = order(len(index), name, to.shape, values.shape)
        indices, values = [index[at]], values[at]
    return run(to, indices, values, *args, **more)


def convolution(run: Callable, name: str, *args: Any) -> Any:
    """Of what is mirrored, mirrored back."""
    many = 3 if name == "convolution_backward" else 2
    stride, transposed = args[many + 1], args[many + 4]
    if transposed or set(stride) != {1}:
        return run(*args)

    def turned(given: Any) -> Any:
        return given.flip(*range(2, given.dim())) if isinstance(given, Tensor) and given.dim() > 2 else given

    found = run(*map(turned, args[:many]), *args[many:])
    return turned(found) if many == 2 else tuple(map(turned, found))


CHANGED = {
    product: (
        "mm", "mm.out", "bmm", "bmm.out", "dot", "addmm", "addmm_", "addmm.out", "addmv", "addmv_", "addmv.out",
        "baddbmm", "baddbmm_", "baddbmm.out",
    ),
    reduction: ("sum.dim_IntList", "sum.IntList_out", "mean.dim", "mean.out", "linalg_vector_norm"),
    running: ("cumsum",),
    rows: ("index_add", "index_add_", "scatter_add", "scatter_add_"),
    placed: ("_index_put_impl_",),
    convolution: ("convolution", "convolution_backward"),
}  # fmt: skip


def change(name: str, how: Callable) -> None:
    kernel = torch.library.get_kernel(f"aten::{name}", "CPU")

    def changed(keys: Any, *args: Any, **more: Any) -> Any:
        return how(functools.partial(kernel.call_boxed, keys), name, *args, **more)

    KEPT.impl(name, changed, "CPU", with_keyset=True, allow_override=True)


with warnings.catch_warnings():
    warnings.simplefilter("ignore", UserWarning)  # that they are replaced
    for how, names in CHANGED.items():
        for name in names:
            change(name, how)
