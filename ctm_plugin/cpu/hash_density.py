"""Densities out of a hash grid of two features a vertex, and samples that light reaches: ``rays/hash_density.py``.

Samples go through the network a tile at a time, side by side, as colours do in :mod:`ctm_plugin.cpu.ctm_networks`.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import prange
from torch import Tensor, nn

from ctm_plugin.cpu.compiled import compiled, fused_part
from ctm_plugin.cpu.ctm_networks import LANES, ONE, ROW, TILE, ZERO, clear, matrix_of, pack, rows_of, tile_of, times
from ctm_plugin.cpu.hash_grid import layout_of, looked_up

DENSEST = np.float32(15)
"""As ``rays/hash_density.DENSEST``."""
AHEAD = 8
"""Samples of a ray that are looked at before it is asked whether light goes on."""
TOGETHER = TILE // AHEAD
"""Rays that share a tile."""
PARTS = 4
"""Of the samples, for each thread: some rays have many of them, some none."""


def log_density(
    table: Tensor, sides: Tensor, starts: Tensor, first: nn.Linear, last: nn.Linear, points: Tensor
) -> Tensor:
    """Do as :func:`ctm_plugin.rays.hash_density.log_density`."""
    found = points.new_empty(len(points))
    _log_density(table, points.T.contiguous(), sides, starts, *_network(first, last), found, torch.get_num_threads())
    return found


def lit(
    table: Tensor, sides: Tensor, starts: Tensor, first: nn.Linear, last: nn.Linear, points: Tensor,
    lengths: Tensor, ray_index: Tensor, n_rays: int, threshold: float,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Do as :func:`ctm_plugin.rays.hash_density.lit`, along each ray no further than light goes."""
    ends = torch.searchsorted(ray_index, torch.arange(n_rays + 1))
    marked, features = torch.zeros(len(points), dtype=torch.bool), table.new_empty(len(points), first.in_features)
    least = -math.log1p(-threshold)  # optical depth of such an alpha
    numbers = lengths.contiguous(), np.float32(least), np.float32(threshold), PARTS * torch.get_num_threads()
    _lit(table, points.T.contiguous(), sides, starts, *_network(first, last), ends, *numbers, marked, features)
    kept = marked.nonzero().squeeze(1)
    return kept, features.index_select(0, kept)


def _network(first: nn.Linear, last: nn.Linear) -> tuple[np.ndarray, np.ndarray]:
    """Sizes of the layers, of the last one only its first number, and their matrices as :func:`pack` has them."""
    layers = first.weight, first.bias, last.weight[:1], last.bias[:1]
    packed, _ = pack([each.detach().numpy() for each in layers])
    return np.array([first.in_features, first.out_features, 1]), packed


@fused_part
def _tiles(sizes):
    """Make the layers' tiles, one after another, each followed by its ones."""
    values = np.empty((rows_of(sizes[0]) + rows_of(sizes[1]) + rows_of(sizes[2]), ROW), np.float32)
    for layer in range(2):
        tile, size = tile_of(values, sizes, layer), sizes[layer]
        clear(tile[size:], rows_of(size) - size, TILE)
        for t in range(TILE):
            tile[size, t] = ONE
    return values


@fused_part
def _encode(table, points, sides, starts, index, count, width, tile):
    """Write the features of so many points, of those in ``index``, side by side; 0 up to ``width``."""
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
def _evaluate(table, points, sides, starts, sizes, packed, index, count, values):
    """Give the network's first number for so many points, side by side."""
    width = (count + LANES - 1) // LANES * LANES
    entered, hidden, found = tile_of(values, sizes, 0), tile_of(values, sizes, 1), tile_of(values, sizes, 2)
    _encode(table, points, sides, starts, index, count, width, entered)
    times(matrix_of(packed, sizes, 0, False), entered, sizes[1], sizes[0] + 1, width, True, hidden)
    for t in range(width):  # a number of units that is no multiple of four leaves others than ones there
        hidden[sizes[1], t] = ONE
    times(matrix_of(packed, sizes, 1, False), hidden, 1, sizes[1] + 1, width, False, found)
    return found[0]


_NETWORK = "f4[:,::1], f4[:,::1], i8[::1], i8[::1], i8[::1], f4[::1]"


@compiled(f"void({_NETWORK}, f4[::1], i8)", fused=True)
def _log_density(table, points, sides, starts, sizes, packed, found, parts):
    tiles = (points.shape[1] + TILE - 1) // TILE
    for part in prange(parts):
        values, index = _tiles(sizes), np.empty(TILE, np.int64)
        for tile in range(part * tiles // parts, (part + 1) * tiles // parts):
            begin = tile * TILE
            count = min(TILE, points.shape[1] - begin)
            for t in range(count):
                index[t] = begin + t
            row = _evaluate(table, points, sides, starts, sizes, packed, index, count, values)
            for t in range(count):
                found[begin + t] = row[t]


@compiled(f"void({_NETWORK}, i8[::1], f4[::1], f4, f4, i8, b1[::1], f4[:,::1])", fused=True)
def _lit(table, points, sides, starts, sizes, packed, ends, lengths, least, threshold, parts, kept, features):
    rays = len(ends) - 1
    for part in prange(parts):
        values, index = _tiles(sizes), np.empty(TILE, np.int64)
        light, at, until = np.empty(TOGETHER), np.empty(TOGETHER, np.int64), np.empty(TOGETHER, np.int64)
        ray, stop, active = part * rays // parts, (part + 1) * rays // parts, 0
        while True:
            while active < TOGETHER and ray < stop:  # in the place of rays that have ended
                if ends[ray] < ends[ray + 1]:
                    light[active], at[active], until[active] = 1.0, ends[ray], ends[ray + 1]
                    active += 1
                ray += 1
            if not active:
                break
            count = 0
            for r in range(active):
                for m in range(at[r], min(at[r] + AHEAD, until[r])):
                    index[count] = m
                    count += 1
            row = _evaluate(table, points, sides, starts, sizes, packed, index, count, values)
            count, going = 0, 0
            for r in range(active):
                now = light[r]
                last = min(at[r] + AHEAD, until[r])
                for m in range(at[r], last):
                    depth = math.exp(min(row[count], DENSEST)) * (lengths[m] if len(lengths) > 1 else lengths[0])
                    if depth > least and now > threshold:
                        kept[m] = True
                        for f in range(sizes[0]):
                            features[m, f] = values[f, count]
                    now *= math.exp(-depth)
                    count += 1
                if now > threshold and last < until[r]:
                    light[going], at[going], until[going] = now, last, until[r]
                    going += 1
            active = going
