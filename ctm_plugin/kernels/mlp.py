"""A network of ReLU layers with its gradients, a tile of rows at a time, whose layers stay in the cache meanwhile.

Matrices that are multiplied from the right are packed in panels: ``COLUMNS`` of their columns, row after row.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from ctm_plugin.kernels.compiled import compiled, function_at, fused_part
from ctm_plugin.kernels.multiply import COLUMNS, product

HEIGHT = 6
"""Rows of a product, whose sums then fill the registers of AVX2."""
TILE = 16 * HEIGHT
"""Rows of a tile."""
SHARES = 64
"""Parts of the work that threads take one by one."""
GROUPS = 16
"""The same where each has a sum of gradients: not as many as threads, so that nothing depends on their number."""
GAP = 16
"""Numbers between the rows of a layer, at least ``HEIGHT``, as products may read so many: rows a power of two apart
would take one another's place in the cache."""

ZERO, ONE = np.float32(0), np.float32(1)
multiply, multiply_add = product(HEIGHT), product(HEIGHT, add=True)
multiply_add_relu, multiply_gated = product(HEIGHT, add=True, relu=True), product(HEIGHT, gated=True)


def fused_mlp(
    table: Tensor, offsets: Tensor, ray: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]
) -> Tensor:
    """ReLU layers, a last linear layer, a sigmoid: ``[N, k]``; gradients go to all but ``ray``.

    Args:
        table: ``[N, D]``, inputs.
        offsets: ``[R, H]``, what the first layer adds for each ray: its bias, and its product with inputs that all rows
            of a ray have in common.
        ray: ``[N]``, ascending.
        weights: of all layers, ``[out, in]``, at least two.
        biases: of all but the first.

    Raises:
        ValueError: rays are not ascending in ``[0, R)``, or shapes do not fit.
    """
    _check(table, offsets, ray, weights, biases)
    return _FusedMLP.apply(
        table.contiguous(),
        offsets.contiguous(),
        ray.contiguous(),
        torch.is_grad_enabled(),
        len(weights),
        *weights,
        *biases,
    )


class _FusedMLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, offsets: Tensor, ray: Tensor, keep: bool, depth: int, *flat: Tensor) -> Tensor:
        weights, biases = flat[:depth], flat[depth:]
        sizes = [table.shape[1], *map(len, weights)]
        tiles = -(-len(table) // TILE)
        groups = min(SHARES, tiles)
        # The first hidden layer is evaluated again, which takes less time than to keep it.
        hidden = table.new_empty(depth - 2, tiles * TILE if keep else groups * TILE, _row(sizes))
        out = table.new_empty(len(table), sizes[-1])
        packed = torch.cat([_panels(weight.T) for weight in weights])
        bias = torch.cat([F.pad(bias, (0, _padded(len(bias)) - len(bias))) for bias in biases])
        mlp_forward(
            _forward_group.address(),
            table,
            offsets,
            ray,
            packed,
            bias,
            np.array(sizes, np.int64),
            keep,
            groups,
            hidden,
            out,
        )
        if keep:
            ctx.save_for_backward(table, offsets, ray, hidden, out, *weights)
            ctx.sizes = sizes
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_out: Tensor) -> tuple[Tensor | None, ...]:
        table, offsets, ray, hidden, out, *weights = ctx.saved_tensors
        sizes, tiles = ctx.sizes, -(-len(table) // TILE)
        groups = min(GROUPS, tiles)
        first, turned = _panels(weights[0].T), torch.cat([_panels(weight) for weight in weights])
        shapes = [(-(-outer // HEIGHT) * HEIGHT, _padded(inner)) for inner, outer in pairwise(sizes)]
        counts = [*map(math.prod, shapes), *sizes[2:]]
        sums = table.new_zeros(groups, sum(counts))
        of_table = torch.empty_like(table) if ctx.needs_input_grad[0] else table[:0]
        of_offsets, of_first = torch.zeros_like(offsets), offsets.new_zeros(groups, offsets.shape[1])
        mlp_backward(
            _backward_group.address(), table, offsets, ray, first, turned, np.array(sizes, np.int64), groups, hidden,
            out, of_out.contiguous(), of_table, of_offsets, of_first, sums,
        )  # fmt: skip
        of_offsets.index_add_(0, ray[[tiles * group // groups * TILE for group in range(groups)]], of_first)
        parts = sums.sum(0).split(counts)
        of_weights = [
            part.view(shape)[: len(weight), : weight.shape[1]]
            for part, shape, weight in zip(parts, shapes, weights, strict=False)
        ]
        of_table = of_table if ctx.needs_input_grad[0] else None
        return of_table, of_offsets, None, None, None, *of_weights, *parts[len(weights) :]


def _check(table, offsets, ray, weights, biases) -> None:
    """Loops do not look."""
    if len(weights) < 2:
        raise ValueError(f"{len(weights)} layers, expected two or more")
    sizes = [table.shape[1], *map(len, weights)]
    shapes = [tuple(each.shape) for each in (*weights, *biases)]
    expected = [(outer, inner) for inner, outer in pairwise(sizes)] + [(outer,) for outer in sizes[2:]]
    if shapes != expected or offsets.shape[1] != sizes[1] or len(ray) != len(table):
        raise ValueError(f"layers {shapes}, offsets {list(offsets.shape)}, {len(table)} inputs on {len(ray)} rays")
    if len(ray) and (ray[0] < 0 or ray[-1] >= len(offsets) or (ray[1:] < ray[:-1]).any()):
        raise ValueError(f"rays {int(ray.min())} to {int(ray.max())}, not ascending in [0, {len(offsets)})")


def _panels(matrix: Tensor) -> Tensor:
    """``[steps, columns]`` packed, its columns filled up with zeros."""
    steps, columns = matrix.shape
    filled = F.pad(matrix, (0, _padded(columns) - columns))
    return filled.view(steps, -1, COLUMNS).transpose(0, 1).reshape(-1)


def _padded(columns: int) -> int:
    return -(-columns // COLUMNS) * COLUMNS


def _row(sizes: list[int]) -> int:
    """From a row of a layer, or of its gradient, to the next."""
    return _padded(max(sizes[1:])) + GAP


@fused_part
def _filled(columns):
    return (columns + COLUMNS - 1) // COLUMNS * COLUMNS


@fused_part
def _high(rows):
    return (rows + HEIGHT - 1) // HEIGHT * HEIGHT


@fused_part
def _fill(values, first, columns, value):
    """Rows of a tile from ``first`` on."""
    for t in range(first, TILE):
        for c in range(columns):
            values[t, c] = value


@fused_part
def _first_layer(table, offsets, ray, packed, start, count, inputs, first):
    """A tile's inputs and first hidden layer."""
    channels, width = table.shape[1], offsets.shape[1]
    for t in range(count):
        for c in range(channels):
            inputs[t, c] = table[start + t, c]
        offset, row = offsets[ray[start + t]], first[t]  # LLVM makes less of an index inside an index
        for c in range(width):
            row[c] = offset[c]
        for c in range(width, _filled(width)):
            row[c] = ZERO
    _fill(inputs, count, channels, ZERO)
    _fill(first, count, _filled(width), ZERO)
    _add_layer(inputs, packed, 0, channels, _filled(width), True, first)


@fused_part
def _layer(below, packed, start, bias, steps, columns, relu, above):
    """``above = below W^T + b`` of a tile, or ReLU of that."""
    for t in range(TILE):
        for c in range(columns):
            above[t, c] = bias[c]
    _add_layer(below, packed, start, steps, columns, relu, above)


@fused_part
def _add_layer(below, packed, start, steps, columns, relu, above):
    """``above += below W^T`` of a tile, or ReLU of that."""
    row = above.shape[1]
    for panel in range(columns // COLUMNS):
        for t in range(0, TILE, HEIGHT):
            if relu:
                multiply_add_relu(
                    below, t * below.shape[1], below.shape[1], 1, packed, start + panel * steps * COLUMNS, COLUMNS,
                    above, t * row + panel * COLUMNS, row, steps,
                )  # fmt: skip
            else:
                multiply_add(
                    below, t * below.shape[1], below.shape[1], 1, packed, start + panel * steps * COLUMNS, COLUMNS,
                    above, t * row + panel * COLUMNS, row, steps,
                )  # fmt: skip


@fused_part
def _layer_gradient(grad, turned, start, values, inner, outer, sums, of_below, gated):
    """``sums += grad^T values`` and ``of_below = grad W`` of a tile, 0 where ReLU made ``values`` 0 if ``gated``."""
    columns, row = _filled(inner), values.shape[1]
    for panel in range(columns // COLUMNS):
        for j in range(0, outer, HEIGHT):
            multiply_add(
                grad, j, 1, grad.shape[1], values, panel * COLUMNS, row,
                sums, j * columns + panel * COLUMNS, columns, TILE,
            )  # fmt: skip
        for t in range(0, TILE if len(of_below) else 0, HEIGHT):
            if gated:
                multiply_gated(
                    grad, t * grad.shape[1], grad.shape[1], 1, turned, start + panel * outer * COLUMNS, COLUMNS,
                    of_below, t * row + panel * COLUMNS, row, outer, values,
                )  # fmt: skip
            else:
                multiply(
                    grad, t * grad.shape[1], grad.shape[1], 1, turned, start + panel * outer * COLUMNS, COLUMNS,
                    of_below, t * row + panel * COLUMNS, row, outer,
                )  # fmt: skip


_FORWARD = "f4[:,::1], f4[:,::1], i8[::1], f4[::1], f4[::1], i8[::1], b1, i8, f4[:,:,::1], f4[:,::1]"


@compiled(f"void({_FORWARD}, i8)", fused=True, parallel=False)
def _forward_group(table, offsets, ray, packed, bias, sizes, keep, groups, hidden, out, group):
    """One group's share of the tiles."""
    layers, tiles = len(sizes) - 1, (len(table) + TILE - 1) // TILE
    inputs = np.zeros((TILE, _filled(sizes[0])), np.float32)
    first = np.zeros((TILE, hidden.shape[2]), np.float32)
    last = np.empty((TILE, _filled(sizes[layers])), np.float32)
    for tile in range(tiles * group // groups, tiles * (group + 1) // groups):
        start, place = tile * TILE, (tile if keep else group) * TILE
        count = min(TILE, len(table) - start)
        _first_layer(table, offsets, ray, packed, start, count, inputs, first)
        below, at, bias_at = first, sizes[0] * _filled(sizes[1]), 0
        for layer in range(1, layers):
            columns = _filled(sizes[layer + 1])
            inside = layer < layers - 1
            above = hidden[layer - 1, place : place + TILE] if inside else last
            _layer(below, packed, at, bias[bias_at : bias_at + columns], sizes[layer], columns, inside, above)
            below, at, bias_at = above, at + sizes[layer] * columns, bias_at + columns
        for t in range(count):
            for c in range(sizes[layers]):
                out[start + t, c] = ONE / (ONE + np.float32(math.exp(-last[t, c])))


_forward_at = function_at(f"void({_FORWARD}, i8)")


@compiled(f"void(i8, {_FORWARD})")
def mlp_forward(address, table, offsets, ray, packed, bias, sizes, keep, groups, hidden, out):
    share = _forward_at(address)
    for group in prange(groups):
        share(table, offsets, ray, packed, bias, sizes, keep, groups, hidden, out, np.int64(group))


_BACKWARD = (
    "f4[:,::1], f4[:,::1], i8[::1], f4[::1], f4[::1], i8[::1], i8, f4[:,:,::1], f4[:,::1], f4[:,::1], f4[:,::1], "
    "f4[:,::1], f4[:,::1], f4[:,::1]"
)


@compiled(f"void({_BACKWARD}, i8)", fused=True, parallel=False)
def _backward_group(
    table, offsets, ray, packed, turned, sizes, groups, hidden, out, of_out, of_table, of_offsets, of_first, sums, group
):
    """One group's share of the tiles. Other groups may have rows of its first ray: that has a sum of its own."""
    layers, tiles, row, own = len(sizes) - 1, (len(table) + TILE - 1) // TILE, hidden.shape[2], sums[group]
    begin = tiles * group // groups
    inputs = np.zeros((TILE, _filled(sizes[0])), np.float32)
    first = np.zeros((TILE, row), np.float32)
    of_inputs = np.empty((TILE if len(of_table) else 0, inputs.shape[1]), np.float32)
    grad, of_below = np.zeros((TILE, row), np.float32), np.zeros((TILE, row), np.float32)
    for tile in range(begin, tiles * (group + 1) // groups):
        start = tile * TILE
        count = min(TILE, len(table) - start)
        _fill(grad, 0, _high(sizes[layers]), ZERO)
        for t in range(count):
            for c in range(sizes[layers]):
                grad[t, c] = of_out[start + t, c] * out[start + t, c] * (ONE - out[start + t, c])
        _first_layer(table, offsets, ray, packed, start, count, inputs, first)
        at, sums_at, bias_at = len(turned), len(own), len(own)
        for layer in range(1, layers):
            sums_at -= sizes[layer + 1]
        for layer in range(layers - 1, -1, -1):
            inner, outer = sizes[layer], sizes[layer + 1]
            columns = _filled(inner)
            at -= outer * columns
            sums_at -= _high(outer) * columns
            if layer:
                values = hidden[layer - 2, start : start + TILE] if layer > 1 else first
                bias_at -= outer
                of_bias = own[bias_at : bias_at + outer]
                for t in range(count):
                    for c in range(outer):
                        of_bias[c] += grad[t, c]
                _layer_gradient(grad, turned, at, values, inner, outer, own[sums_at:], of_below, True)
                grad, of_below = of_below, grad
            else:
                _layer_gradient(grad, turned, at, inputs, inner, outer, own, of_inputs, False)
        for t in range(count):
            r = ray[start + t]
            target = of_first[group] if r == ray[begin * TILE] else of_offsets[r]
            for c in range(len(target)):
                target[c] += grad[t, c]
        for t in range(count if len(of_table) else 0):
            for c in range(sizes[0]):
                of_table[start + t, c] = of_inputs[t, c]


_backward_at = function_at(f"void({_BACKWARD}, i8)")


@compiled(f"void(i8, {_BACKWARD})")
def mlp_backward(
    address, table, offsets, ray, packed, turned, sizes, groups, hidden, out, of_out, of_table, of_offsets, of_first,
    sums,
):  # fmt: skip
    share = _backward_at(address)
    for group in prange(groups):
        share(
            table, offsets, ray, packed, turned, sizes, groups, hidden, out, of_out, of_table, of_offsets, of_first,
            sums, np.int64(group),
        )  # fmt: skip
