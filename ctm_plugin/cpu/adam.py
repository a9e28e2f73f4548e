"""Adam of the rows of a table that have a gradient, in one pass through memory."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from ctm_plugin.cpu.compiled import compiled


@compiled("void(f4[:,::1], f4[:,::1], f4[:,::1], i8[::1], f4[:,::1], f4[:,::1], f4[::1])")
def adam_rows(table, exp_avg, exp_avg_sq, rows, grad, rates, numbers):
    """Step ``rows`` by ``grad``; a row of zeros in it rests, moments included (Kingma & Ba, ICLR 2015).

    Args:
        table, exp_avg, exp_avg_sq: ``[V, c]``, changed in place.
        rows: ``[N]``, none twice; empty if ``grad`` is of all rows.
        grad: ``[N, c]``.
        rates: ``[V, 1]``, factors on the step, or ``[0, 1]``: 1.
        numbers: ``1 - beta1``, ``beta2``, ``1 - beta2``, ``lr / (1 - beta1^step)``,
            ``sqrt(1 - beta2^step)``, eps.
    """
    new1, keep2, new2 = numbers[0], numbers[1], numbers[2]
    lr, correction, eps = numbers[3], numbers[4], numbers[5]
    for i in prange(len(grad)):
        seen = False
        for c in range(grad.shape[1]):
            seen |= grad[i, c] != 0
        if seen:
            row = rows[i] if len(rows) else np.int64(i)
            rate = rates[row, 0] * lr if len(rates) else lr
            for c in range(grad.shape[1]):
                change = grad[i, c]
                first = exp_avg[row, c] + (change - exp_avg[row, c]) * new1
                second = exp_avg_sq[row, c] * keep2 + change * change * new2
                exp_avg[row, c] = first
                exp_avg_sq[row, c] = second
                table[row, c] -= rate * first / (math.sqrt(second) / correction + eps)
