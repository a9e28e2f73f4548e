"""Compilation and launch of Triton kernels."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import torch
import triton
from torch import Tensor

VARYING = {"count", "along", "across"}
"""Names of integer arguments that change from step to step; Triton compiles no variant for those that divide by 16 or
are 1."""


def kernel(function: Callable) -> Any:
    """Decorate a function as a Triton kernel, or a part of one, compiled at its first launch."""
    raw = inspect.unwrap(function)  # type checkers of tests wrap functions
    return triton.jit(raw, do_not_specialize=[name for name in inspect.signature(raw).parameters if name in VARYING])


def launch(of: Any, programs: tuple[int, ...], *arguments: Any, **options: Any) -> None:
    """Launch a kernel with a grid of ``programs``, on the device of its first argument; do nothing for an empty grid.

    Products and sums are not fused, so that two kernels find the same number by the same formula.

    Args:
        of: the kernel.
        programs: number of programs along each axis of the grid.
        arguments: tensors, which are contiguous where the kernel does not ask for strides, and numbers.
        options: the kernel's constants, and Triton's options.
    """
    if all(programs):
        with torch.cuda.device_of(arguments[0]):
            of[programs](*arguments, enable_fp_fusion=False, **options)


def whole(*tensors: Tensor) -> tuple[Tensor, ...]:
    """Give contiguous versions of tensors."""
    return tuple(each.contiguous() for each in tensors)
