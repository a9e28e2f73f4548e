"""Loop of Adam for the rows of a table that have a gradient, in one pass through memory."""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import prange
from torch import Tensor

from ctm_plugin.cpu.compiled import compiled, inlined


def step_table(
    table: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, rates: Tensor | None, step: int,
    lr: float, betas: tuple[float, float], eps: float,
) -> None:  # fmt: skip
    """Step a table by Adam in place (:func:`ctm_plugin.optim.grid_adam.step_table`); a sparse gradient's rows only.

    Raises:
        ValueError: shapes do not fit.
    """
    rows, grad = _rows_of(grad) if grad.is_sparse else (torch.empty(0, dtype=torch.long), grad)
    (beta1, beta2), rates = betas, table.new_empty(0, 1) if rates is None else rates
    size, correction = lr / (1 - beta1**step), (1 - beta2**step) ** 0.5
    numbers = torch.tensor([1 - beta1, beta2, 1 - beta2, size, correction, eps], dtype=table.dtype)
    shapes = {each.shape for each in (table, exp_avg, exp_avg_sq)}
    given = len(grad) == len(rows) or (not len(rows) and len(grad) == len(table))
    if len(shapes) > 1 or len(rates) not in (0, len(table)) or not given:
        raise ValueError(f"tables {shapes}, rates of {len(rates)} rows, a gradient of {len(grad)}")
    adam_rows(table, exp_avg, exp_avg_sq, rows, grad.contiguous(), rates, numbers)
    torch.autograd.graph.increment_version(table)


def _rows_of(grad: Tensor) -> tuple[Tensor, Tensor]:
    """Rows ``[N]`` and values ``[N, c]`` of a sparse gradient, duplicate rows added up."""
    rows = grad._indices()[0]
    # Autograd forgets that a gradient is coalesced, and to sort it again takes longer than the step.
    if not (rows[1:] > rows[:-1]).all():
        grad = grad.coalesce()
    return grad._indices()[0].contiguous(), grad._values()


ROW_BLOCK = 1024
"""Rows that are tested for a gradient before those with one are stepped."""


@inlined
def _step(table, exp_avg, exp_avg_sq, row, c, change, rate, numbers):
    """Step one number of a table, and its moments, by Adam (Kingma & Ba, ICLR 2015)."""
    first = exp_avg[row, c] + (change - exp_avg[row, c]) * numbers[0]
    second = exp_avg_sq[row, c] * numbers[1] + change * change * numbers[2]
    exp_avg[row, c] = first
    exp_avg_sq[row, c] = second
    table[row, c] -= rate * first / (math.sqrt(second) / numbers[4] + numbers[5])


@compiled("void(f4[:,::1], f4[:,::1], f4[:,::1], i8[::1], f4[:,::1], f4[:,::1], f4[::1])")
def adam_rows(table, exp_avg, exp_avg_sq, rows, grad, rates, numbers):
    """Step a table's ``rows`` by Adam with ``grad``; rows of zero gradient rest, moments included.

    Args:
        table, exp_avg, exp_avg_sq: ``[V, c]``, changed in place.
        rows: ``[N]``, none twice; empty if ``grad`` is of all rows.
        grad: ``[N, c]``.
        rates: ``[V, 1]``, factors on the step, or ``[0, 1]``: 1.
        numbers: ``1 - beta1``, ``beta2``, ``1 - beta2``, ``lr / (1 - beta1^step)``,
            ``sqrt(1 - beta2^step)``, eps.
    """
    channels = grad.shape[1]
    for block in prange((len(grad) + ROW_BLOCK - 1) // ROW_BLOCK):
        # Which rows have a gradient no processor foresees: they are written down first, without asking.
        seen, count = np.empty(ROW_BLOCK, np.int64), 0
        for i in range(block * ROW_BLOCK, min((block + 1) * ROW_BLOCK, len(grad))):
            some = grad[i, 0] != 0
            if channels == 2:  # of hash grids; the loop would take longer to enter than to run
                some |= grad[i, 1] != 0
            else:
                for c in range(1, channels):
                    some |= grad[i, c] != 0
            seen[count] = i
            count += some
        for at in range(count):
            i = seen[at]
            row = rows[i] if len(rows) else i
            rate = rates[row, 0] * numbers[3] if len(rates) else numbers[3]
            for c in range(channels):
                _step(table, exp_avg, exp_avg_sq, row, c, grad[i, c], rate, numbers)
