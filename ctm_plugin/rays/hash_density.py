"""Densities out of a hash grid and a small network, without gradients, to choose the samples that are worth one.

The network has one hidden layer with a ReLU; of what it gives only the first number is looked at, the logarithm of the
density.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ctm_plugin.door import looped
from ctm_plugin.rays.hash_grid import encoded
from ctm_plugin.rays.volume import volume_weights

MAX_LOG_DENSITY = 15.0
"""Largest logarithm of a density: a thousandth of a side then stops all light."""


@looped("hash_density:log_density", when=lambda table, *_: table.shape[1] == 2)
@torch.no_grad()
def log_density(
    table: Tensor, sides: Tensor, starts: Tensor, first: nn.Linear, last: nn.Linear, points: Tensor
) -> Tensor:
    """Evaluate the logarithm of the density, ``[M]``, at points.

    Args:
        table, sides, starts: of a hash grid, see :func:`ctm_plugin.rays.hash_grid.encoded`.
        first, last: the network's layers.
        points: ``[M, 3]`` in [0, 1].
    """
    return _first(encoded(table, points, sides, starts), first, last)


@looped("hash_density:visible_samples", when=lambda table, *_: table.shape[1] == 2)
@torch.no_grad()
def visible_samples(
    table: Tensor, sides: Tensor, starts: Tensor, first: nn.Linear, last: nn.Linear, points: Tensor,
    lengths: Tensor, ray_index: Tensor, n_rays: int, threshold: float,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Find the packed samples with alpha that light reaches: ``alpha_i > threshold`` and ``T_i > threshold``.

    With optical depths ``exp(min(r, 15)) length`` of the network's ``r``; see :func:`volume_weights`.

    Args:
        table, sides, starts, first, last, points: see :func:`log_density`.
        lengths: lengths of the samples, ``[M]``, or ``[1]``: one for all.
        ray_index: ``[M]``, ascending.
        n_rays: R.
        threshold: in [0, 1).

    Returns:
        Their indices ``[N]``, ascending, and features ``[N, L F]``.
    """
    features = encoded(table, points, sides, starts)
    raw = _first(features, first, last)
    optical_depth = raw.clamp_max(MAX_LOG_DENSITY).exp() * lengths
    weights, _ = volume_weights(optical_depth, ray_index, n_rays)
    alpha = -torch.expm1(-optical_depth)
    kept = ((alpha > threshold) & (weights > threshold * alpha)).nonzero().squeeze(1)
    return kept, features.index_select(0, kept)


def _first(features: Tensor, first: nn.Linear, last: nn.Linear) -> Tensor:
    """The network's first output, the logarithm of the density, ``[M]`` float32."""
    return F.linear(first(features).relu(), last.weight[:1], last.bias[:1]).squeeze(1).float()
