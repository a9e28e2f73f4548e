"""Kernel of Adam for the rows of a table that have a gradient: :func:`ctm_plugin.optim.grid_adam.step_table`."""

from __future__ import annotations

import torch
import triton.language as tl
from torch import Tensor
from triton import cdiv, next_power_of_2

from ctm_plugin.gpu.kernels import kernel, launch

ELEMENT_BLOCK = 1024
"""Elements of a table that one program of the kernel steps."""


def step_table(
    table: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, rates: Tensor | None, step: int,
    lr: float, betas: tuple[float, float], eps: float,
) -> None:  # fmt: skip
    """Step a table by Adam in place (:func:`ctm_plugin.optim.grid_adam.step_table`); rows without gradient are skipped.

    Raises:
        ValueError: a table is not contiguous.
    """
    if not (table.is_contiguous() and exp_avg.is_contiguous() and exp_avg_sq.is_contiguous()):
        raise ValueError("tables that are not contiguous")
    grad, (beta1, beta2) = (grad.to_dense() if grad.is_sparse else grad).contiguous(), betas
    width = next_power_of_2(table.shape[1])
    rows = max(1, ELEMENT_BLOCK // width)
    launch(
        _step, (cdiv(len(table), rows),),
        table.detach(), grad, exp_avg, exp_avg_sq, table if rates is None else rates.contiguous(), len(table),
        1 - beta1, beta2, 1 - beta2, lr / (1 - beta1**step), (1 - beta2**step) ** 0.5, eps,
        CHANNELS=table.shape[1], WIDTH=width, ROWS=rows, RATED=rates is not None,
    )  # fmt: skip
    torch.autograd.graph.increment_version(table)


@kernel
def _step(
    table, grad, exp_avg, exp_avg_sq, rates, count, part, beta2, part2, size, correction, eps,
    CHANNELS: tl.constexpr, WIDTH: tl.constexpr, ROWS: tl.constexpr, RATED: tl.constexpr,
):  # fmt: skip
    row, channel = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS), tl.arange(0, WIDTH)
    at = row[:, None] * CHANNELS + channel[None, :]
    there = (row < count)[:, None] & (channel < CHANNELS)[None, :]
    change = tl.load(grad + at, mask=there, other=0.0)
    seen = tl.max((change != 0).to(tl.int32), axis=1) > 0
    there = there & seen[:, None]
    first = tl.load(exp_avg + at, mask=there, other=0.0)
    first += (change - first) * part
    second = tl.load(exp_avg_sq + at, mask=there, other=0.0)
    second = second * beta2 + change * change * part2
    step = first / (tl.sqrt_rn(second) / correction + eps) * size
    if RATED:
        step *= tl.load(rates + row, mask=seen, other=0.0)[:, None]
    tl.store(exp_avg + at, first, mask=there)
    tl.store(exp_avg_sq + at, second, mask=there)
    tl.store(table + at, tl.load(table + at, mask=there, other=0.0) - step, mask=there)
