"""How far rounding may take a result, by its type and the count of operations, where bits need not be the same.

The same call with the same shapes, layouts and threads gives the same bits on one machine, and so do data movement and
single operations (+, -, *, /, sqrt) that IEEE 754 rounds. Two *different* calls of a product do not: batched or not, in
blocks or whole, they may add up in another order and fuse other pairs of operations.

No bound holds after steps of Adam, whose first ones are the signs of gradients. Other threads, processes, devices,
kernels, batches or orders are compared by the losses and gradients of one step from one state, whole trainings by their
scores; to the bit only where the same is added up in the same order.
"""

from __future__ import annotations

import torch
from torch import Tensor


def gamma(count: int, dtype: torch.dtype) -> float:
    """``n u / (1 - n u)``, u half of the type's eps: what ``count`` roundings one after another change, relatively.

    Higham, Accuracy and Stability of Numerical Algorithms, 2nd edition, lemma 3.1.
    """
    rounded = count * torch.finfo(dtype).eps / 2
    return rounded / (1 - rounded)


def of_sums(sizes: Tensor, count: int, dtype: torch.dtype | None = None) -> Tensor:
    """How far apart two ways to add up ``count`` products may be: ``2 gamma_n sum |a_i b_i|``.

    Each way is off by half of that at most, whatever the order, fused or not: Higham, (3.5).

    Args:
        sizes: ``sum |a_i b_i|`` of each result.
        count: products in a sum; one more for what is added to it.
        dtype: they are rounded to; ``None``: that of ``sizes``.
    """
    return 2 * gamma(count, dtype or sizes.dtype) * sizes


def of_functions(values: Tensor, ulps: int = 4) -> Tensor:
    """How far apart two evaluations of an elementwise function may be: ``ulps`` units in the last place of ``values``.

    Vectors and the rest of a row take other instructions. SLEEF, which torch calls, promises 1 ulp for exp, sin, log
    and pow, as good libraries do for single numbers; what is left is for the roundings round it.
    """
    return ulps * torch.finfo(values.dtype).eps * values.abs().clamp_min(torch.finfo(values.dtype).tiny)


def assert_within(found: Tensor, expected: Tensor, bound: Tensor | float) -> None:
    """Of one type and shape, and nowhere further apart than ``bound``; what is no number is."""
    assert found.dtype == expected.dtype
    assert found.shape == expected.shape
    apart = (found - expected).abs()
    assert (apart <= bound).all(), f"up to {float((apart / bound).max()):.3g} times the bound of {bound}"
