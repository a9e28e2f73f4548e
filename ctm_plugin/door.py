"""Dispatch of a plain torch function to faster versions of it: a numba loop on a CPU, a Triton kernel on a GPU."""

from __future__ import annotations

import functools
import importlib
import importlib.util
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor, nn

registered: dict[str, Callable] = {}
"""Every function with a loop or a kernel, by module and name. Its ``reference`` is plain torch; its ``loop`` and
``kernel`` are names or ``None``."""


def looped(
    loop: str | None = None, when: Callable[..., bool] = lambda *_: True, kernel: str | None = None
) -> Callable[[Callable], Callable]:
    """Let a loop or a kernel run in a function's place, where :func:`may_run` or :func:`may_launch` its arguments,
    which are given by their places.

    The function itself is plain torch: other devices and types run it, and tests compare with it.

    Args:
        loop: ``module:name`` in the room ``cpu``, of the same arguments and results; imported when it is first wanted.
        when: tells from the arguments whether the loop applies to them.
        kernel: ``module:name`` in the room ``gpu``, likewise. At first it is tried once on each device, see
            :mod:`ctm_plugin.gpu.trial`.
    """

    @functools.cache
    def found() -> Callable:
        return named("cpu", loop)

    def decorate(reference: Callable) -> Callable:
        @functools.cache
        def tried(device: torch.device) -> Callable:
            return named("gpu", "trial:tried")(kernel, partial(named, "gpu", kernel), reference, device)

        @functools.wraps(reference)
        def call(*arguments: Any) -> Any:
            if loop and when(*arguments) and may_run(arguments):
                return found()(*arguments)
            if kernel and may_launch(arguments):
                return tried(next(_tensors(arguments)).device)(*arguments)
            return reference(*arguments)

        call.reference, call.loop, call.kernel = reference, loop, kernel
        registered[f"{reference.__module__}.{reference.__name__}"] = call
        return call

    return decorate


def named(room: str, what: str) -> Callable:
    """Import the function ``module:name`` of a room, ``cpu`` or ``gpu``."""
    module, name = what.split(":")
    return attrgetter(name)(importlib.import_module(f"{__package__}.{room}.{module}"))


def may_run(arguments: Iterable[Any]) -> bool:
    """Tell whether loops can take such arguments: tensors on the CPU, those of real numbers in float32. Never without
    numba or with ``NUMBA_DISABLE_JIT``.
    """
    real = (each for each in _tensors(arguments) if each.is_floating_point())
    return all(each.device.type == "cpu" and each.dtype == torch.float32 for each in real) and _compiles()


def may_launch(arguments: Iterable[Any]) -> bool:
    """Tell whether kernels can take such arguments: tensors on one GPU, those of real numbers in float32. Never
    without Triton, or where torch must be deterministic: kernels add up in any order.
    """
    tensors = list(_tensors(arguments))
    on_one = len({each.device for each in tensors}) == 1 and tensors[0].device.type == "cuda"
    real = all(each.dtype == torch.float32 for each in tensors if each.is_floating_point())
    return on_one and real and not torch.are_deterministic_algorithms_enabled() and _has_triton()


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


@functools.cache
def _has_triton() -> bool:
    return importlib.util.find_spec("triton") is not None
