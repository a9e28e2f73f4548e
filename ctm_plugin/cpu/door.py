"""The one door to this room's loops: a plain torch function, and the loop that may run in its place on a CPU."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Iterable, Iterator
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor, nn

registered: dict[str, Callable] = {}
"""Every function that has a loop, by its module's name and its own; ``reference`` of it is the plain one."""


def looped(loop: str, when: Callable[..., bool] = lambda *_: True) -> Callable[[Callable], Callable]:
    """Let a loop run in a function's place, where :func:`may_run` its arguments, which are given by their places.

    The function itself is plain torch: what GPUs run, and what tests compare the loop with.

    Args:
        loop: ``module:name`` in this room, of the same arguments and results; imported when it is first wanted.
        when: of the arguments, whether the loop is for them.
    """
    module, name = loop.split(":")

    @functools.cache
    def found() -> Callable:
        return attrgetter(name)(importlib.import_module(f"{__package__}.{module}"))

    def decorate(reference: Callable) -> Callable:
        @functools.wraps(reference)
        def call(*arguments: Any) -> Any:
            run = found() if when(*arguments) and may_run(arguments) else reference
            return run(*arguments)

        call.reference = reference
        registered[f"{reference.__module__}.{reference.__name__}"] = call
        return call

    return decorate


def may_run(arguments: Iterable[Any]) -> bool:
    """Tell whether loops are for such arguments: all tensors of real numbers on the CPU, in float32. None are without
    numba or with ``NUMBA_DISABLE_JIT``.
    """
    real = (each for each in _tensors(arguments) if each.is_floating_point())
    return all(each.device.type == "cpu" and each.dtype == torch.float32 for each in real) and _compiles()


def _tensors(arguments: Iterable[Any]) -> Iterator[Tensor]:
    for each in arguments:
        if isinstance(each, Tensor):
            yield each
        elif isinstance(each, nn.Module):
            yield from each.parameters()
        elif isinstance(each, list | tuple):
            yield from _tensors(each)


@functools.cache
def _compiles() -> bool:
    try:
        import numba
    except ImportError:
        return False
    return not numba.config.DISABLE_JIT
