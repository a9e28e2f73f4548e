"""An MLP on embedded positions on a CPU: the same numbers, in blocks of rows that stay in the cache."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from ctm_plugin.rays.encoding import embed

BLOCK = 4096
"""Rows a block: 4 MiB of float32 at width 256."""


def blocked_mlp(points: Tensor, frequencies: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    """ReLU layers on :func:`~ctm_plugin.rays.encoding.embed`, a last linear layer, a sigmoid: ``[N, k]``.

    Products are of autocast's type where it is on; positions then enter as the sum of two numbers of that type, which
    keeps 16 bits of them. All else is of the points' type.

    Args:
        points: ``[N, D]``.
        frequencies: ``[P]`` of the embedding.
        weights, biases: of all layers, ``[out, in]`` and ``[out]``, at least two.
    """
    dtype = torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else points.dtype
    keep = torch.is_grad_enabled()
    return _BlockedMLP.apply(points, frequencies, dtype, keep, *weights, *biases)


class _BlockedMLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx, points, frequencies, dtype, keep, *flat):
        depth = len(flat) // 2
        weights, biases = list(flat[:depth]), list(flat[depth:])
        if dtype != points.dtype:
            dims = points.shape[1]
            weights[0] = torch.cat([weights[0][:, :dims], weights[0]], dim=1)
            weights, biases = [w.to(dtype) for w in weights], [*(b.to(dtype) for b in biases[:-1]), biases[-1]]
        rows = len(points)
        kept_rows = rows if keep else min(rows, BLOCK)
        tables = [points.new_empty(kept_rows, weight.shape[1], dtype=dtype) for weight in weights]
        out = points.new_empty(rows, len(weights[-1]))
        for start in range(0, rows, BLOCK):
            block = points[start : start + BLOCK]
            at = slice(start, start + BLOCK) if keep else slice(0, len(block))
            _enter(block, frequencies, tables[0][at])
            for weight, bias, source, target in zip(weights, biases, tables, tables[1:], strict=False):
                torch.addmm(bias, source[at], weight.T, out=target[at]).relu_()
            shown = F.linear(tables[-1][at], weights[-1]).to(points.dtype)
            torch.sigmoid(shown.add_(biases[-1]), out=out[start : start + BLOCK])
        if keep:
            ctx.save_for_backward(points, frequencies, out)
            ctx.weights, ctx.tables = weights, tables
        return out

    @staticmethod
    def backward(ctx, of_out):
        points, frequencies, out = ctx.saved_tensors
        weights, tables = ctx.weights, ctx.tables
        of_points = torch.zeros_like(points) if ctx.needs_input_grad[0] else None
        of_weights = [weight.new_zeros(weight.shape, dtype=points.dtype) for weight in weights]
        of_biases = [points.new_zeros(len(weight)) for weight in weights]
        dims = points.shape[1]
        for start in range(0, len(points), BLOCK):
            at = slice(start, start + BLOCK)
            grad = of_out[at] * out[at] * (1 - out[at])
            of_biases[-1] += grad.sum(0)
            grad = grad.to(weights[0].dtype)
            for index in range(len(weights) - 1, -1, -1):
                hidden = tables[index][at]
                of_weights[index] += grad.T @ hidden
                if index == 0:
                    break
                grad = torch.ops.aten.threshold_backward(grad @ weights[index], hidden, 0)
                of_biases[index - 1] += grad.sum(0, dtype=points.dtype)
            if of_points is not None:
                of_points[at] = _leave(grad @ weights[0], tables[0][at], frequencies, dims)
        if tables[0].dtype != points.dtype:
            # Both halves of a position have the same weight.
            of_weights[0] = torch.cat(
                [of_weights[0][:, :dims] + of_weights[0][:, dims : 2 * dims], of_weights[0][:, 2 * dims :]], dim=1
            )
        return of_points, None, None, None, *of_weights, *of_biases


def _enter(points: Tensor, frequencies: Tensor, out: Tensor) -> None:
    """The embedding ``[N, E]``; of another type, with what rounding takes from the positions in D columns before."""
    embedded, dims = embed(points, frequencies), points.shape[1]
    out[:, -embedded.shape[1] :] = embedded
    if out.dtype != points.dtype:
        out[:, :dims] = points - out[:, dims : 2 * dims]


def _leave(grad: Tensor, entered: Tensor, frequencies: Tensor, dims: int) -> Tensor:
    """The gradient of positions ``[N, D]``, of that of what :func:`_enter` gave."""
    waves = len(frequencies) * dims
    plain = grad.shape[1] - 2 * waves - dims
    grad, entered = grad.to(frequencies.dtype), entered.to(frequencies.dtype)
    (of_sin, of_cos), (sin, cos) = (
        (table[:, plain + dims : plain + dims + waves], table[:, plain + dims + waves :]) for table in (grad, entered)
    )
    slopes = (of_sin * cos - of_cos * sin).unflatten(1, (-1, dims)) * frequencies[:, None]
    return grad[:, plain : plain + dims] + slopes.sum(1)
