"""Packed samples to the colours of their rays: what fields that skip free space have in common."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from ctm_plugin.cpu.blocked_mlp import blocked_mlp, product_dtype
from ctm_plugin.rays.volume import segment_sums, volume_weights


@dataclass
class Samples:
    """The packed samples that reached the colour of their rays.

    Attributes:
        latent: ``[M, k]`` in [0, 1].
        weights: ``[M]``.
        t: ``[M]``, where they lie along the field's rays.
        ray: ``[M]``.
        passed: ``[R]``, the transmittance behind the last sample of each ray.
    """

    latent: Tensor
    weights: Tensor
    t: Tensor
    ray: Tensor
    passed: Tensor


def marched(
    depth: Tensor,
    t: Tensor,
    ray: Tensor,
    background: Tensor,
    *,
    count: int,
    behind: float,
    threshold: float,
    distances: Callable[[Tensor, Tensor], Tensor],
    shade: Callable[[Tensor, Tensor], Tensor],
) -> tuple[Tensor, Tensor, Samples]:
    """Render rays: latent ``[R, k]``, expected depth ``[R]``, and the samples behind them.

    Args:
        depth: optical depths ``[M]`` of packed samples.
        t, ray: ``[M]``, where they lie, and on which ray.
        background: ``[R, k]`` or ``[1, k]`` latent.
        count: R.
        behind: distance in the world at which light that nothing stops counts as stopped.
        threshold: samples with less alpha, or less weight, are skipped.
        distances: in the world, of samples at ``t`` on ``ray``.
        shade: latents ``[N, k]`` of samples, given their indices ``[N]`` and rays; asked of those with weight alone.
    """
    keep = (depth.detach() > -math.log1p(-threshold)).nonzero().squeeze(1)
    depth, t, ray = taken(keep, depth, t, ray)
    weights, passed = volume_weights(depth, ray, count)
    with torch.no_grad():
        expected = segment_sums(weights * distances(t, ray), ray, count) + passed * behind

    seen = (weights.detach() > threshold).nonzero().squeeze(1)
    weights, t, ray, keep = taken(seen, weights, t, ray, keep)
    latent = shade(keep, ray)
    rendered = segment_sums(weights[:, None] * latent, ray, count) + passed[:, None] * background
    return rendered, expected, Samples(latent, weights, t, ray, passed)


def taken(keep: Tensor, *tables: Tensor) -> tuple[Tensor, ...]:
    """Rows of tables. ``index_select`` as indexing takes two to three times as long; nothing where all are kept."""
    if len(keep) == len(tables[0]):
        return tables
    return tuple(table.index_select(0, keep) for table in tables)


class DirectedMLP(nn.Module):
    """Features and a view direction to a latent: ``depth`` linear layers with ReLU between them, then a sigmoid.

    A subclass gives ``embed``.

    Args:
        features: of a sample.
        embedded: numbers that a direction becomes.
        channels: of the latent.
        width, depth: of the hidden layers, and how many layers there are.
    """

    def __init__(self, features: int, embedded: int, channels: int, width: int, depth: int):
        super().__init__()
        sizes = [features + embedded] + [width] * (depth - 1)
        hidden = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.ReLU(inplace=True))]
        self.layers = nn.Sequential(*hidden, nn.Linear(sizes[-1], channels))
        nn.init.zeros_(self.layers[-1].bias)

    def embed(self, directions: Tensor) -> Tensor:
        """``[R, 3]``, unit length, to ``[R, embedded]``."""
        raise NotImplementedError

    def forward(self, features: Tensor, directions: Tensor, ray: Tensor) -> Tensor:
        """``[M, features]``, ``[R, 3]``, ``[M]`` to ``[M, channels]`` in [0, 1]."""
        embedded = self.embed(directions)
        if features.device.type != "cpu":
            return self.whole(features, embedded, ray)
        entry, layers = FeaturesAndDirections(embedded.to(product_dtype(features)), ray), self.layers[::2]
        return blocked_mlp(features, entry, [layer.weight for layer in layers], [layer.bias for layer in layers])

    def whole(self, features: Tensor, embedded: Tensor, ray: Tensor) -> Tensor:
        """All samples in one go, for autograd: what GPUs run, and what tests compare the blocks with."""
        return self.layers(torch.cat([features, embedded[ray]], dim=-1)).float().sigmoid()


class FeaturesAndDirections:
    """The entry of features ``[M, features]``: they and the embedded direction of their rays.

    Args:
        embedded: ``[R, E]``.
        ray: ``[M]``.
    """

    def __init__(self, embedded: Tensor, ray: Tensor):
        self.embedded, self.ray = embedded, ray

    def enter(self, table: Tensor, at: slice, out: Tensor) -> None:
        features = table.shape[1]
        out[:, :features] = table
        out[:, features:] = self.embedded.index_select(0, self.ray[at])

    def leave(self, grad: Tensor, entered: Tensor) -> Tensor:
        return grad[:, : -self.embedded.shape[1]]
