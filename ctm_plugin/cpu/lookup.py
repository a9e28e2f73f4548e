"""Loops of trilinear lookups of one channel, and of the gradient of any number of channels."""

from __future__ import annotations

import numpy as np
import torch
from numba import prange
from torch import Tensor

from ctm_plugin.cpu.compiled import compiled

ROW_BLOCK = 256
"""Rows a block; blocks without an index are skipped."""
LOG2_OWNED_ROWS = 12
"""log2 of contiguous rows per thread: a ray stays within them for a while, which branch prediction likes."""
SERIAL_NUMBERS = 1 << 19
"""Most numbers that one thread adds up faster than several threads, each of which searches for its own rows."""


SPARSE_FACTOR = 5
"""Table rows per used row from which a sparse gradient pays. Measured, Adam included: at 5 to 6 both take equally
long."""


def numbers_at(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """Sum ``weights[m, i] table[rows[m, i]]`` over i, of a table ``[V, 1]``: ``[M, 1]``."""
    values = table.new_empty(len(rows), 1)
    _numbers_at(table.reshape(-1), rows.int(), weights, values.view(-1))
    return values


@compiled("void(f4[::1], i4[:,::1], f4[:,::1], f4[::1])", fused=True)
def _numbers_at(table, rows, weights, values):
    for m in prange(rows.shape[0]):
        total = np.float32(0)
        for corner in range(rows.shape[1]):
            total += weights[m, corner] * table[rows[m, corner]]
        values[m] = total


def gradient(rows: Tensor, weights: Tensor, grad: Tensor, shape: torch.Size, sparse: bool) -> Tensor:
    """Add up a table's gradient (:func:`ctm_plugin.rays.grid.scattered`); ``sparse`` where few rows are used."""
    rows = rows.int()
    if sparse and SPARSE_FACTOR * rows.numel() < shape.numel():
        touched, sums = sums_of_rows(rows, weights, grad, shape[0])
        return torch.sparse_coo_tensor(touched[None], sums, shape, is_coalesced=True, check_invariants=False)
    sums = grad.new_zeros(shape)
    add_rows(rows, weights, grad, rows.new_empty(0), sums)
    return sums


def sums_of_rows(rows: Tensor, weights: Tensor, grad: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Find the rows of a table that points touch, ascending, and each one's sum of ``weights[m, i] grad[m]``.

    Args:
        rows, weights: ``[M, 8]``, as of :class:`~ctm_plugin.rays.grid.Corners`.
        grad: ``[M, c]``.
        count: rows of the table.
    """
    index = rows.new_empty(count)
    touched = torch.from_numpy(_touched(rows, rows.new_zeros(count, dtype=torch.uint8), index))
    sums = grad.new_zeros(len(touched), grad.shape[1])
    add_rows(rows, weights, grad, index, sums)
    return touched, sums


def add_rows(rows: Tensor, weights: Tensor, grad: Tensor, index: Tensor, sums: Tensor) -> None:
    """Add ``weights[m, i] grad[m]`` to ``sums[index[rows[m, i]]]`` in place; empty ``index``: ``sums[rows[m, i]]``."""
    parts = 1 << torch.get_num_threads().bit_length() - 1
    few = grad.shape[1] == 1 and sums.numel() < SERIAL_NUMBERS
    _add(rows, weights, grad.contiguous(), index, sums, 1 if few else parts)


@compiled("i8[::1](i4[:,::1], u1[::1], i4[::1])")
def _touched(rows, touched, index):
    """Rows ``[N]`` of a table that corners ``rows`` ``[M, 8]`` name, ascending.

    Args:
        touched: ``[V]`` zeros, left with ones where a row is named.
        index: ``[V]``, left with the position in the result of each row that is named.
    """
    blocks = (len(touched) + ROW_BLOCK - 1) // ROW_BLOCK
    named = np.zeros(blocks, np.uint8)
    for m in prange(rows.shape[0]):
        for corner in range(rows.shape[1]):
            row = rows[m, corner]
            if not touched[row]:  # other threads need not fetch again what has not changed
                touched[row] = 1
                named[row // ROW_BLOCK] = 1
    ends = np.zeros(blocks + 1, np.int64)
    for block in prange(blocks):
        count = 0
        if named[block]:
            for row in range(block * ROW_BLOCK, min((block + 1) * ROW_BLOCK, len(touched))):
                count += touched[row]
        ends[block + 1] = count
    ends = ends.cumsum()
    used = np.empty(ends[-1], np.int64)
    for block in prange(blocks):
        if named[block]:
            at = ends[block]
            for row in range(block * ROW_BLOCK, min((block + 1) * ROW_BLOCK, len(touched))):
                if touched[row]:
                    used[at] = row
                    index[row] = at
                    at += 1
    return used


@compiled("void(i4[:,::1], f4[:,::1], f4[:,::1], i4[::1], f4[:,::1], i8)")
def _add(rows, weights, grad, index, sums, parts):
    """Each of ``parts`` threads, a power of two of them, goes through all corners and adds up rows of its own.

    So no two threads write to one row, and sums are in the order of the points for any number of threads.
    """
    for part in prange(parts):
        for m in range(rows.shape[0]):
            for corner in range(rows.shape[1]):
                row = rows[m, corner]
                if (row >> LOG2_OWNED_ROWS) & (parts - 1) == part:
                    at = index[row] if len(index) else row
                    weight = weights[m, corner]
                    for c in range(grad.shape[1]):
                        sums[at, c] += weight * grad[m, c]
