"""Making and launching of kernels."""

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
    """Make a function a Triton kernel, or a part of one, compiled when it is first launched."""
    raw = inspect.unwrap(function)  # type checkers of tests wrap functions
    return triton.jit(raw, do_not_specialize=[name for name in inspect.signature(raw).parameters if name in VARYING])


def launch(of: Any, programs: tuple[int, ...], *arguments: Any, **options: Any) -> None:
    """Run so many programs of a kernel, on the device of its first argument; none of none.

    Every product and every sum is rounded, so that two kernels find the same number by the same formula.

    Args:
        of: the kernel.
        programs: along each axis.
        arguments: tensors, which are contiguous where the kernel does not ask for strides, and numbers.
        options: the kernel's constants, and Triton's options.
    """
    if all(programs):
        with torch.cuda.device_of(arguments[0]):
            of[programs](*arguments, enable_fp_fusion=False, **options)


def whole(*tensors: Tensor) -> tuple[Tensor, ...]:
    """Make tensors contiguous."""
    return tuple(each.contiguous() for each in tensors)
