"""A small network on a sinusoidal embedding, for a tile of colours at a time: parts of compiled functions.

A tile's values are ``[rows, TILE]``, colours side by side, so that a loop over them fills whole registers. Each layer's
rows are followed by one of ones, by which its biases are weights. Nothing of a tile leaves the cache.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from ctm_plugin.cpu.compiled import fused_part

TILE = 256
"""Colours of a tile, at most."""
LANES = 32
"""Tiles are filled up to a multiple of so many, which fill two registers of AVX-512."""
ROW = TILE + 16
"""From a row of a tile to the next: a power of two apart they would take one another's place in the cache."""

# numba would take float64 for products of float32 with Python's numbers.
ZERO, HALF, ONE, TWO, PI = (np.float32(value) for value in (0, 0.5, 1, 2, math.pi))
SINE = tuple(np.float32((-1) ** n / math.factorial(2 * n + 1)) for n in range(6))
COSINE = tuple(np.float32((-1) ** n / math.factorial(2 * n)) for n in range(7))
"""Series whose errors are below 6e-8 up to half of pi."""
EXPONENTIAL = tuple(np.float32(1 / math.factorial(n)) for n in range(8))
"""The same up to half of ln 2."""
LOG_E, LN_2, EXPONENTS = np.float32(1 / math.log(2)), np.float32(math.log(2)), np.float32(126)


@fused_part
def power_of_two(exponent):
    """Make ``2^n`` of an int32 in -126..127, as a float32."""
    return np.int32((exponent + 127) << 23).view(np.float32)


def padded(size):
    """Count the rows for so many values and the ones; products go four by four."""
    return (size + 1 + 3) // 4 * 4


rows_of = fused_part(padded)


@fused_part
def tile_of(buffer, sizes, layer):
    """Find a layer's rows ``[rows, ROW]`` in the buffer of all layers."""
    at = 0
    for each in range(layer):
        at += rows_of(sizes[each])
    return buffer[at : at + rows_of(sizes[layer])]


@fused_part
def matrix_of(packed, sizes, layer, turned):
    """Find a layer's matrix ``[rows(out), rows(in)]``, or turned ``[rows(in), rows(out)]``."""
    at = 0
    for each in range(layer):
        at += rows_of(sizes[each]) * rows_of(sizes[each + 1])
    inner, outer = rows_of(sizes[layer]), rows_of(sizes[layer + 1])
    part = packed[at : at + inner * outer]
    return part.reshape(inner, outer) if turned else part.reshape(outer, inner)


def pack(layers: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Put all layers' matrices in one row, with biases as the column of the ones; and turned, without.

    Args:
        layers: of each layer its weight ``[out, in]``, then its bias ``[out]``.
    """
    packed, turned = [], []
    for weight, bias in zip(layers[::2], layers[1::2], strict=True):
        outer, inner = weight.shape
        matrix = np.zeros((padded(outer), padded(inner)), np.float32)
        matrix[:outer, :inner] = weight
        turned.append(matrix.T.ravel())
        matrix[:outer, inner] = bias
        packed.append(matrix.ravel())
    return np.concatenate(packed), np.concatenate(turned)


def unpack(packed: np.ndarray, layers: Sequence[np.ndarray]) -> Iterator[np.ndarray]:
    """Undo what :func:`pack` did: arrays ``[out, in]`` and ``[out]``, like the layers'."""
    start = 0
    for weight in layers[::2]:
        (outer, inner), (rows, columns) = weight.shape, map(padded, weight.shape)
        matrix = packed[start : start + rows * columns].reshape(rows, columns)
        yield from (np.ascontiguousarray(matrix[:outer, :inner]), np.ascontiguousarray(matrix[:outer, inner]))
        start += rows * columns


@fused_part
def count_of(sizes):
    """Count the numbers of a network in the row that :func:`pack` makes."""
    count = 0
    for layer in range(len(sizes) - 1):
        count += rows_of(sizes[layer]) * rows_of(sizes[layer + 1])
    return count


@fused_part
def network(packed, turned, of_packed, sizes):
    """Make ``(sizes, packed, turned, of_packed, values, grads)``: layers, their gradients' sums, tiles and theirs."""
    rows = 0
    for size in sizes:
        rows += rows_of(size)
    values, grads = np.empty((rows, ROW), np.float32), np.empty((rows, ROW), np.float32)
    for layer in range(len(sizes)):  # rows that fill a layer up, which add_outer reads
        for table in (values, grads):
            clear(tile_of(table, sizes, layer)[sizes[layer] :], rows_of(sizes[layer]) - sizes[layer], TILE)
    values[sizes[0]] = ONE
    return sizes, packed, turned, of_packed, values, grads


@fused_part
def fill(colors, start, stop, width, tile):
    """Copy rows ``start`` to ``stop`` of colours ``[N, C]`` into a tile, side by side; the rest of it is black."""
    for c in range(colors.shape[1]):
        for t in range(stop - start):
            tile[c, t] = colors[start + t, c]
        for t in range(stop - start, width):
            tile[c, t] = ZERO


@fused_part
def empty_out(tile, start, stop, colors):
    """Copy a tile's columns back into rows ``start`` to ``stop`` of colours ``[N, C]``."""
    for n in range(start, stop):
        for c in range(colors.shape[1]):
            colors[n, c] = tile[c, n - start]


@fused_part
def clear(tile, rows, width):
    for c in range(rows):
        for t in range(width):
            tile[c, t] = ZERO


@fused_part
def copy(tile, rows, width, out):
    for c in range(rows):
        for t in range(width):
            out[c, t] = tile[c, t]


@fused_part
def add(tile, rows, width, factor, out):
    for c in range(rows):
        for t in range(width):
            out[c, t] += factor * tile[c, t]


@fused_part
def outputs(net):
    """Find the tile of a network's last layer, and that of its gradient."""
    sizes, _, _, _, values, grads = net
    return tile_of(values, sizes, len(sizes) - 1), tile_of(grads, sizes, len(sizes) - 1)


@fused_part
def forward(net, frequencies, scale, width):
    """Evaluate a network on the colours in the first rows of its values; what comes out is in the last."""
    sizes, packed, _, _, values, _ = net
    layers = len(sizes) - 1
    embed(values, sizes[0] // (1 + 2 * frequencies), frequencies, scale, width)
    for layer in range(layers):
        inner, outer = sizes[layer], sizes[layer + 1]
        below, above = tile_of(values, sizes, layer), tile_of(values, sizes, layer + 1)
        times(matrix_of(packed, sizes, layer, False), below, outer, inner + 1, width, layer < layers - 1, above)
        if layer < layers - 1:
            for t in range(width):
                above[outer, t] = ONE
        else:
            sigmoid(above, outer, width)


@fused_part
def sigmoid(tile, rows, width):
    """Apply the sigmoid in place.

    The exponential is a power of two and a series, as libraries' would be called colour by colour.
    """
    for c in range(rows):
        row = tile[c]
        for t in range(width):
            power = row[t] * -LOG_E
            power = -EXPONENTS if power < -EXPONENTS else power
            power = EXPONENTS if power > EXPONENTS else power
            whole = np.floor(power + HALF)
            rest = (power - whole) * LN_2
            series = EXPONENTIAL[6] + rest * EXPONENTIAL[7]
            series = EXPONENTIAL[4] + rest * (EXPONENTIAL[5] + rest * series)
            series = EXPONENTIAL[2] + rest * (EXPONENTIAL[3] + rest * series)
            series = EXPONENTIAL[0] + rest * (EXPONENTIAL[1] + rest * series)
            row[t] = ONE / (ONE + series * power_of_two(np.int32(whole)))


@fused_part
def backward(net, frequencies, scale, width, of_color):
    """Carry the gradient in the last rows back: into the layers' sums and, if ``of_color``, into the first rows."""
    sizes, _, turned, of_packed, values, grads = net
    layers = len(sizes) - 1
    last, of_last = tile_of(values, sizes, layers), tile_of(grads, sizes, layers)
    for c in range(sizes[layers]):
        for t in range(width):
            of_last[c, t] *= last[c, t] * (ONE - last[c, t])
    for layer in range(layers - 1, -1, -1):
        inner, outer = sizes[layer], sizes[layer + 1]
        below, of_below = tile_of(values, sizes, layer), tile_of(grads, sizes, layer)
        of_above = tile_of(grads, sizes, layer + 1)
        add_outer(of_above, below, outer, inner + 1, width, matrix_of(of_packed, sizes, layer, False))
        if layer:
            times_gated(matrix_of(turned, sizes, layer, True), of_above, inner, outer, width, below, of_below)
        elif of_color:
            times(matrix_of(turned, sizes, layer, True), of_above, inner, outer, width, False, of_below)
    if of_color:
        of_embedding(values, grads, sizes[0] // (1 + 2 * frequencies), frequencies, scale, width)


@fused_part
def embed(table, channels, frequencies, scale, width):
    """Embed the colours in the first rows of the table as :func:`ctm_plugin.rays.encoding.embed` does.

    Angles are doubled: ``sin 2x = 2 sin x cos x``, ``cos 2x = 1 - 2 sin^2 x``. An angle's own rounding doubles from one
    frequency to the next as well, so that nothing is lost.
    """
    half_turns = scale / PI
    for c in range(channels if frequencies else 0):
        sine, cosine = channels + c, channels * (1 + frequencies) + c
        for t in range(width):
            turn = table[c, t] * half_turns
            whole = np.floor(turn + HALF)
            angle = (turn - whole) * PI
            square = angle * angle
            sine_of = SINE[4] + square * SINE[5]
            sine_of = SINE[2] + square * (SINE[3] + square * sine_of)
            sine_of = angle * (SINE[0] + square * (SINE[1] + square * sine_of))
            cosine_of = COSINE[5] + square * COSINE[6]
            cosine_of = COSINE[3] + square * (COSINE[4] + square * cosine_of)
            cosine_of = COSINE[0] + square * (COSINE[1] + square * (COSINE[2] + square * cosine_of))
            sign = ONE - TWO * (whole - TWO * np.floor(whole * HALF))
            table[sine, t] = sign * sine_of
            table[cosine, t] = sign * cosine_of
        for low in range(frequencies - 1):
            sine, cosine = channels * (1 + low) + c, channels * (1 + frequencies + low) + c
            for t in range(width):
                sine_of, cosine_of = table[sine, t], table[cosine, t]
                table[sine + channels, t] = TWO * sine_of * cosine_of
                table[cosine + channels, t] = ONE - TWO * sine_of * sine_of


@fused_part
def of_embedding(table, of_table, channels, frequencies, scale, width):
    """Add the gradient of the colours, out of that of their embedding, to its first rows."""
    for c in range(channels):
        for low in range(frequencies):
            sine, cosine = channels * (1 + low) + c, channels * (1 + frequencies + low) + c
            factor = scale * np.float32(1 << low)
            for t in range(width):
                of_angle = of_table[sine, t] * table[cosine, t] - of_table[cosine, t] * table[sine, t]
                of_table[c, t] += factor * of_angle


@fused_part
def times(weight, values, rows, steps, width, relu, out):
    """Multiply: ``out = weight values``, or ReLU of it, of so many columns of the weight.

    Four rows and four columns of the weight at a time, which stay in registers while LLVM goes along the colours.
    """
    for j in range(0, rows, 4):
        o0, o1, o2, o3 = out[j], out[j + 1], out[j + 2], out[j + 3]
        clear(out[j:], 4, width)
        for k in range(0, steps, 4):
            p0, p1, p2, p3 = values[k], values[k + 1], values[k + 2], values[k + 3]
            a0, a1, a2, a3 = weight[j, k], weight[j, k + 1], weight[j, k + 2], weight[j, k + 3]
            b0, b1, b2, b3 = weight[j + 1, k], weight[j + 1, k + 1], weight[j + 1, k + 2], weight[j + 1, k + 3]
            c0, c1, c2, c3 = weight[j + 2, k], weight[j + 2, k + 1], weight[j + 2, k + 2], weight[j + 2, k + 3]
            d0, d1, d2, d3 = weight[j + 3, k], weight[j + 3, k + 1], weight[j + 3, k + 2], weight[j + 3, k + 3]
            for t in range(width):
                v0, v1, v2, v3 = p0[t], p1[t], p2[t], p3[t]
                o0[t] += a0 * v0 + a1 * v1 + a2 * v2 + a3 * v3
                o1[t] += b0 * v0 + b1 * v1 + b2 * v2 + b3 * v3
                o2[t] += c0 * v0 + c1 * v1 + c2 * v2 + c3 * v3
                o3[t] += d0 * v0 + d1 * v1 + d2 * v2 + d3 * v3
        if relu:
            for i in range(j, j + 4):
                row = out[i]
                for t in range(width):
                    row[t] = ZERO if row[t] <= ZERO else row[t]


@fused_part
def times_gated(weight, grad, rows, steps, width, values, out):
    """Multiply: ``out = weight grad``, through ReLU, whose results the values are."""
    times(weight, grad, rows, steps, width, False, out)
    for i in range(rows):
        for t in range(width):
            out[i, t] = ZERO if values[i, t] <= ZERO else out[i, t]


@fused_part
def add_outer(grad, values, rows, inner, width, out):
    """Add the product ``grad values^T`` to ``out``, two rows and four columns of it at a time."""
    for j in range(0, rows, 2):
        for k in range(0, inner, 4):
            a0 = a1 = a2 = a3 = b0 = b1 = b2 = b3 = ZERO
            for t in range(width):
                a, b = grad[j, t], grad[j + 1, t]
                v0, v1, v2, v3 = values[k, t], values[k + 1, t], values[k + 2, t], values[k + 3, t]
                a0 += a * v0
                a1 += a * v1
                a2 += a * v2
                a3 += a * v3
                b0 += b * v0
                b1 += b * v1
                b2 += b * v2
                b3 += b * v3
            out[j, k] += a0
            out[j, k + 1] += a1
            out[j, k + 2] += a2
            out[j, k + 3] += a3
            out[j + 1, k] += b0
            out[j + 1, k + 1] += b1
            out[j + 1, k + 2] += b2
            out[j + 1, k + 3] += b3
