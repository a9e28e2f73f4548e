"""Choice of the library for float32 matrix products on a CPU: oneDNN, where it is as exact as MKL."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import torch

PRODUCT_SHAPES = ((64, 27, 64), (512, 34, 256), (2048, 256, 256), (512, 256, 3))
"""Rows, inner and outer sizes of the tested products: colour transforms, first, hidden and last layers."""
MAX_ERROR = 2e-6
"""Largest relative error of a float32 product, with room; with bfloat16 inside it is a thousand times as much."""


@contextmanager
def fast_products(device: torch.device) -> Iterator[bool]:
    """Context in which oneDNN multiplies float32 matrices on the CPU, instead of MKL, if that loses no precision.

    MKL uses AVX-512 only on its maker's processors; oneDNN uses it on all, and is twice as fast on others. torch asks
    oneDNN only where float32 products may be rounded to bfloat16 inside (``set_float32_matmul_precision("medium")``).
    Whether this processor's kernels do round is tried out: if so, or on another device, nothing changes.

    Yields:
        Whether oneDNN was taken.
    """
    before = torch.get_float32_matmul_precision()
    if device.type != "cpu" or before != "highest":
        yield False
        return
    try:
        torch.set_float32_matmul_precision("medium")
        taken = _exact(torch.get_num_threads())
        if not taken:
            torch.set_float32_matmul_precision(before)
        yield taken
    finally:
        torch.set_float32_matmul_precision(before)


@cache
def _exact(threads: int) -> bool:
    """Whether float32 products are exact under torch's present settings; tested once for each number of threads."""
    return max(product_error(*shape) for shape in PRODUCT_SHAPES) < MAX_ERROR


@torch.no_grad()
def product_error(rows: int, inner: int, outer: int) -> float:
    """Measure the relative error of a float32 product ``[rows, inner] x [inner, outer]`` as torch is set now."""
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(rows, inner, generator=generator), torch.randn(inner, outer, generator=generator)
    exact = a.double() @ b.double()
    return ((a @ b - exact).norm() / exact.norm()).item()
