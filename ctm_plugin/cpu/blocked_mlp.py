"""An MLP on a CPU in blocks of rows that stay in the cache; results equal torch's to rounding."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from torch import Tensor

BLOCK_BYTES = 1 << 21
"""Bytes of a block of the widest layer."""
ROW_MULTIPLE = 128
"""The last block is padded with zero rows to a multiple of this: oneDNN takes a millisecond to prepare products of a
new shape."""
COLUMN_STEP = 8
"""The first layer's input has a column of ones, for its bias, and is padded to a multiple of this: products with an odd
number of columns take half as long again."""


@runtime_checkable
class Entry(Protocol):
    """Protocol of the first layer's input, made of a table ``[N, D]``, a block of rows at a time."""

    def enter(self, table: Tensor, at: slice, out: Tensor) -> None:
        """Write the first layer's input of a block into ``out`` ``[n, E]``, of the products' type.

        Args:
            table: ``[n, D]``, the block's rows.
            at: where these rows lie in the whole table.
            out: what is written to.
        """

    def leave(self, grad: Tensor, entered: Tensor) -> Tensor:
        """Turn the gradient of the input ``[n, E]``, which was ``entered``, into that of the block ``[n, D]``."""


def blocked_mlp(
    table: Tensor, entry: Entry, weights: Sequence[Tensor], biases: Sequence[Tensor], sigmoid: bool = True
) -> Tensor:
    """Apply ReLU layers on what ``entry`` makes of a table, a last linear layer, a sigmoid: ``[N, k]``.

    Products are of :func:`product_dtype`, all else of the table's type. Gradients go to the table, the weights and the
    biases.

    Args:
        table: ``[N, D]``.
        entry: makes the first layer's input of the table's rows.
        weights, biases: of all layers, ``[out, in]`` and ``[out]``, at least two.
        sigmoid: whether a sigmoid follows the last layer.
    """
    return _BlockedMLP.apply(table, entry, product_dtype(table), torch.is_grad_enabled(), sigmoid, *weights, *biases)


def product_dtype(table: Tensor) -> torch.dtype:
    """Dtype of products with a table ``[N, D]``: autocast's where it is on, else the table's."""
    return torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else table.dtype


class _BlockedMLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx, table, entry, dtype, keep, sigmoid, *flat):
        depth = len(flat) // 2
        entered = flat[0].shape[1]
        first = torch.cat([flat[0], flat[depth][:, None]], dim=1)
        weights = [F.pad(first, (0, -first.shape[1] % COLUMN_STEP)).to(dtype), *(w.to(dtype) for w in flat[1:depth])]
        biases = [*(b.to(dtype) for b in flat[depth + 1 : -1]), flat[-1]]
        blocks = _blocks(len(table), weights)
        kept_rows = sum(rows for _, rows in blocks) if keep else max((rows for _, rows in blocks), default=0)
        inputs = [table.new_empty(kept_rows, weight.shape[1], dtype=dtype) for weight in weights]
        inputs[0][:, entered:] = 0
        inputs[0][:, entered] = 1
        out = table.new_empty(len(table), len(weights[-1]))
        for whole, rows in blocks:
            start = whole.start if keep else 0
            at, count = slice(start, start + rows), whole.stop - whole.start
            entry.enter(table[whole], whole, inputs[0][start : start + count, :entered])
            inputs[0][start + count : start + rows] = 0
            torch.mm(inputs[0][at], weights[0].T, out=inputs[1][at]).relu_()
            for index in range(1, depth - 1):
                torch.addmm(biases[index - 1], inputs[index][at], weights[index].T, out=inputs[index + 1][at]).relu_()
            shown = F.linear(inputs[-1][at], weights[-1])[:count].to(table.dtype)
            torch.add(shown, biases[-1], out=out[whole])
            if sigmoid:
                out[whole].sigmoid_()
        if keep:
            ctx.save_for_backward(out)
            ctx.entry, ctx.weights, ctx.inputs = entry, weights, inputs
            ctx.columns, ctx.entered, ctx.sigmoid = table.shape[1], entered, sigmoid
        return out

    @staticmethod
    def backward(ctx, of_out):
        (out,) = ctx.saved_tensors
        weights, inputs, entered = ctx.weights, ctx.inputs, ctx.entered
        of_table = out.new_empty(len(out), ctx.columns) if ctx.needs_input_grad[0] else None
        of_weights = [weight.new_zeros(weight.shape, dtype=out.dtype) for weight in weights]
        of_biases = [out.new_zeros(len(weight)) for weight in weights[1:]]
        for whole, rows in _blocks(len(out), weights):
            at, count = slice(whole.start, whole.start + rows), whole.stop - whole.start
            grad = torch.ops.aten.sigmoid_backward(of_out[whole], out[whole]) if ctx.sigmoid else of_out[whole]
            grad = F.pad(grad, (0, 0, 0, rows - count))
            for index in range(len(weights) - 1, 0, -1):
                of_biases[index - 1] += _sums(grad)
                grad, hidden = grad.to(weights[0].dtype), inputs[index][at]
                of_weights[index] += grad.T @ hidden
                grad = torch.ops.aten.threshold_backward(grad @ weights[index], hidden, 0)
            of_weights[0] += grad.T @ inputs[0][at]
            if of_table is not None:
                of_input = (grad @ weights[0])[:count, :entered]
                of_table[whole] = ctx.entry.leave(of_input, inputs[0][at][:count, :entered])
        of_first, of_bias = of_weights[0][:, :entered], of_weights[0][:, entered]
        return of_table, None, None, None, None, of_first, *of_weights[1:], of_bias, *of_biases


def _sums(grad: Tensor) -> Tensor:
    """Column sums: ``[n, E]`` to ``[E]``. Those of half precision are products with ones, which take an eighth of
    the time of torch's sums and are rounded as the weights' gradients are.
    """
    return grad.sum(0) if grad.dtype == torch.float32 else (grad.new_ones(1, len(grad)) @ grad).squeeze(0)


def _blocks(rows: int, weights: Sequence[Tensor]) -> list[tuple[slice, int]]:
    """Split ``rows`` into blocks: each block's slice, and its number of rows with padding."""
    size = max(1, BLOCK_BYTES // max(weight[0].nbytes for weight in weights) // ROW_MULTIPLE) * ROW_MULTIPLE
    blocks = [slice(start, min(start + size, rows)) for start in range(0, rows, size)]
    return [(block, math.ceil((block.stop - block.start) / ROW_MULTIPLE) * ROW_MULTIPLE) for block in blocks]
