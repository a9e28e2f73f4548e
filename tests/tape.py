"""What a CUDA graph does, on the CPU: operators are written down with the tensors they read and write, and run again.

As there, what is replayed reads and writes the memory that it was recorded with, and no Python runs.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes, _get_current_dispatch_mode
from torch.utils._pytree import tree_leaves, tree_map


class Tape(TorchDispatchMode):
    """Operators that made or changed something."""

    def __init__(self) -> None:
        super().__init__()
        self.operators: list[tuple[Any, tuple, dict, list[Tensor]]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs = kwargs or {}
        found = func(*args, **kwargs)
        name = func.overloadpacket.__name__
        if name in ("_local_scalar_dense", "nonzero", "masked_select", "equal", "_unique2", "unique_dim"):
            raise RuntimeError(f"{name} would wait for a GPU")
        given = [leaf.untyped_storage().data_ptr() for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        made = [leaf for leaf in tree_leaves(found) if isinstance(leaf, Tensor)]
        fresh = [each for each in made if each.untyped_storage().data_ptr() not in given]
        if fresh or func._schema.is_mutable:  # not what only looks at a tensor in another way
            args, kwargs, fresh = tree_map(
                lambda leaf: leaf.detach() if isinstance(leaf, Tensor) else leaf, (args, kwargs, fresh)
            )
            self.operators.append((func, args, kwargs, fresh))
        return found

    def play(self) -> None:
        with torch.no_grad(), torch.autocast("cpu", enabled=False):  # what was cast is written down
            for func, args, kwargs, fresh in self.operators:
                found = [leaf for leaf in tree_leaves(func(*args, **kwargs)) if isinstance(leaf, Tensor)]
                for each, again in zip(fresh, found if fresh else [], strict=True):
                    each.copy_(again)


def kernel(function: Callable[..., tuple[Tensor, ...]]) -> Callable[..., tuple[Tensor, ...]]:
    """Let a function count as one operator, as a kernel does, whatever it does within."""

    def call(*args: Any) -> tuple[Tensor, ...]:
        if (tape := _get_current_dispatch_mode()) is None:
            return function(*args)
        with _disable_current_modes():
            found = function(*args)
        tape.operators.append((function, args, {}, list(found)))
        return found

    return call


def record(compute: Callable[[], Any]) -> tuple[Callable[[], None], Any]:
    """Do as :func:`ctm_plugin.gpu.replay.record`."""
    compute()
    tape = Tape()
    with tape:
        found = compute()
    return tape.play, found
