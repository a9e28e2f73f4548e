"""Densities out of a hash grid of two features a vertex, and samples that light reaches: ``rays/hash_density.py``.

Samples go through the network a tile at a time. A tile's values are ``[rows, ROW]``, samples side by side, so that a
loop over them fills whole registers; a layer's rows are followed by one of ones, by which its biases are weights, and
filled up to fours. Nothing of a tile leaves the cache.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import prange
from torch import Tensor, nn

from ctm_plugin.cpu.compiled import compiled, fused_part
from ctm_plugin.cpu.hash_grid import layout_of, looked_up

# numba would take float64 for products of float32 with Python's numbers.
ZERO, ONE = np.float32(0), np.float32(1)
MAX_LOG = np.float32(15)
"""Largest logarithm of a density, as in :mod:`ctm_plugin.rays.hash_density`."""
TILE_SAMPLES = 256
"""Most samples in a tile, the batch that goes through the network at once."""
SAMPLE_MULTIPLE = 32
"""Tiles are padded to a multiple of this: two registers of AVX-512."""
STRIDE = TILE_SAMPLES + 16
"""Numbers from a tile's row to the next: rows a power of two apart would share cache lines."""
RAY_SAMPLES = 8
"""Samples of a ray that are evaluated before its transmittance is tested."""
TILE_RAYS = TILE_SAMPLES // RAY_SAMPLES
"""Rays that share a tile."""
PARTS_PER_THREAD = 4
"""Parts of the samples for each thread: some rays have many samples, some none."""


def log_density(
    table: Tensor, sides: Tensor, starts: Tensor, first: nn.Linear, last: nn.Linear, points: Tensor
) -> Tensor:
    """Logarithm of the density ``[M]`` at points, see :func:`ctm_plugin.rays.hash_density.log_density`."""
    density = points.new_empty(len(points))
    _log_density(table, points.T.contiguous(), sides, starts, *_network(first, last), density, torch.get_num_threads())
    return density


def visible_samples(
    table: Tensor, sides: Tensor, starts: Tensor, first: nn.Linear, last: nn.Linear, points: Tensor,
    lengths: Tensor, ray_index: Tensor, n_rays: int, threshold: float,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """As :func:`ctm_plugin.rays.hash_density.visible_samples`, on each ray only as far as light goes."""
    ends = torch.searchsorted(ray_index, torch.arange(n_rays + 1))
    marked, features = torch.zeros(len(points), dtype=torch.bool), table.new_empty(len(points), first.in_features)
    least = -math.log1p(-threshold)  # optical depth of such an alpha
    numbers = lengths.contiguous(), np.float32(least), np.float32(threshold), PARTS_PER_THREAD * torch.get_num_threads()
    _lit(table, points.T.contiguous(), sides, starts, *_network(first, last), ends, *numbers, marked, features)
    kept = marked.nonzero().squeeze(1)
    return kept, features.index_select(0, kept)


def _network(first: nn.Linear, last: nn.Linear) -> tuple[np.ndarray, Tensor, Tensor]:
    """Input sizes of the two layers, and their matrices; of the last layer only the first output's."""
    return np.array([first.in_features, first.out_features]), _matrix(first, first.out_features), _matrix(last, 1)


def _matrix(layer: nn.Linear, outer: int) -> Tensor:
    """Weight matrix of a layer's first ``outer`` outputs, with the biases as a column, padded to multiples of four."""
    inner = layer.in_features
    matrix = torch.zeros((outer + 4) // 4 * 4, (inner + 4) // 4 * 4)
    matrix[:outer, :inner], matrix[:outer, inner] = layer.weight[:outer].detach(), layer.bias[:outer].detach()
    return matrix


@fused_part
def _clear(tile, rows, width):
    for c in range(rows):
        for t in range(width):
            tile[c, t] = ZERO


@fused_part
def _tiles(sizes, first, last):
    """Allocate the tiles of both layers' inputs and of the last layer's output."""
    entered, hidden = (np.empty((first.shape[1], STRIDE), np.float32), np.empty((last.shape[1], STRIDE), np.float32))
    for tile, size in ((entered, sizes[0]), (hidden, sizes[1])):
        _clear(tile[size:], len(tile) - size, TILE_SAMPLES)
        for t in range(TILE_SAMPLES):
            tile[size, t] = ONE
    return entered, hidden, np.empty((last.shape[0], STRIDE), np.float32)


@fused_part
def _times(weight, values, rows, steps, width, relu, out):
    """Multiply ``out = weight values``, or its ReLU, for ``width`` samples and the weight's first ``steps`` columns.

    Four rows and four columns of the weight at a time, which stay in registers while LLVM goes along the samples.
    """
    for j in range(0, rows, 4):
        o0, o1, o2, o3 = out[j], out[j + 1], out[j + 2], out[j + 3]
        _clear(out[j:], 4, width)
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
def _encode(table, points, sides, starts, index, count, width, tile):
    """Write the features of ``count`` points, chosen by ``index``, side by side into a tile; 0 up to ``width``."""
    for level in range(len(sides)):
        side, start = sides[level], starts[level]
        layout = layout_of(side, starts[level + 1] - start)
        for t in range(count):
            first, second = looked_up(table, points, index[t], side, start, layout)
            tile[2 * level, t] = first
            tile[2 * level + 1, t] = second
        for t in range(count, width):
            tile[2 * level, t] = tile[2 * level + 1, t] = ZERO


@fused_part
def _evaluate(table, points, sides, starts, sizes, first, last, index, count, tiles):
    """Evaluate the network's first output, the log density, for ``count`` points, side by side."""
    entered, hidden, out = tiles
    width = (count + SAMPLE_MULTIPLE - 1) // SAMPLE_MULTIPLE * SAMPLE_MULTIPLE
    _encode(table, points, sides, starts, index, count, width, entered)
    _times(first, entered, sizes[1], sizes[0] + 1, width, True, hidden)
    for t in range(width):  # a number of units that is no multiple of four leaves others than ones there
        hidden[sizes[1], t] = ONE
    _times(last, hidden, 1, sizes[1] + 1, width, False, out)
    return out[0]


_NETWORK = "f4[:,::1], f4[:,::1], i8[::1], i8[::1], i8[::1], f4[:,::1], f4[:,::1]"


@compiled(f"void({_NETWORK}, f4[::1], i8)", fused=True)
def _log_density(table, points, sides, starts, sizes, first, last, density, parts):
    tiles = (points.shape[1] + TILE_SAMPLES - 1) // TILE_SAMPLES
    for part in prange(parts):
        values, index = _tiles(sizes, first, last), np.empty(TILE_SAMPLES, np.int64)
        for tile in range(part * tiles // parts, (part + 1) * tiles // parts):
            begin = tile * TILE_SAMPLES
            count = min(TILE_SAMPLES, points.shape[1] - begin)
            for t in range(count):
                index[t] = begin + t
            row = _evaluate(table, points, sides, starts, sizes, first, last, index, count, values)
            for t in range(count):
                density[begin + t] = row[t]


@compiled(f"void({_NETWORK}, i8[::1], f4[::1], f4, f4, i8, b1[::1], f4[:,::1])", fused=True)
def _lit(table, points, sides, starts, sizes, first, last, ends, lengths, least, threshold, parts, kept, features):
    rays = len(ends) - 1
    for part in prange(parts):
        values, index = _tiles(sizes, first, last), np.empty(TILE_SAMPLES, np.int64)
        light, at, until = np.empty(TILE_RAYS), np.empty(TILE_RAYS, np.int64), np.empty(TILE_RAYS, np.int64)
        ray, stop, active = part * rays // parts, (part + 1) * rays // parts, 0
        while True:
            while active < TILE_RAYS and ray < stop:  # in the place of rays that have ended
                if ends[ray] < ends[ray + 1]:
                    light[active], at[active], until[active] = 1.0, ends[ray], ends[ray + 1]
                    active += 1
                ray += 1
            if not active:
                break
            count = 0
            for r in range(active):
                for m in range(at[r], min(at[r] + RAY_SAMPLES, until[r])):
                    index[count] = m
                    count += 1
            row = _evaluate(table, points, sides, starts, sizes, first, last, index, count, values)
            count, going = 0, 0
            for r in range(active):
                now = light[r]
                end = min(at[r] + RAY_SAMPLES, until[r])
                for m in range(at[r], end):
                    depth = math.exp(min(row[count], MAX_LOG)) * (lengths[m] if len(lengths) > 1 else lengths[0])
                    if depth > least and now > threshold:
                        kept[m] = True
                        for f in range(sizes[0]):
                            features[m, f] = values[0][f, count]
                    now *= math.exp(-depth)
                    count += 1
                if now > threshold and end < until[r]:
                    light[going], at[going], until[going] = now, end, until[r]
                    going += 1
            active = going
