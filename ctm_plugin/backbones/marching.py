"""Packed samples to the colours of their rays: what fields that skip free space have in common."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from ctm_plugin.cpu.blocked_mlp import blocked_mlp, product_dtype
from ctm_plugin.rays.volume import distortion, occlusion, segment_sums, volume_weights


@dataclass
class Samples:
    """The packed samples that reached the colour of their rays.

    Attributes:
        latent: ``[M, k]`` in [0, 1].
        weights: ``[M]``.
        t: ``[M]``, where they lie along the field's rays.
        ray_index: ``[M]``, on which ray each lies.
        transmittance: ``[R]``, behind the last sample of each ray.
    """

    latent: Tensor
    weights: Tensor
    t: Tensor
    ray_index: Tensor
    transmittance: Tensor


def marched(
    optical_depth: Tensor,
    t: Tensor,
    ray_index: Tensor,
    background: Tensor,
    *,
    n_rays: int,
    behind: float,
    threshold: float,
    distances: Callable[[Tensor, Tensor], Tensor],
    shade: Callable[[Tensor, Tensor], Tensor],
) -> tuple[Tensor, Tensor, Samples]:
    """Render rays: latent ``[R, k]``, expected depth ``[R]``, and the samples behind them.

    Args:
        optical_depth: of packed samples, ``[M]``.
        t, ray_index: ``[M]``, where they lie, and on which ray.
        background: ``[R, k]`` or ``[1, k]`` latent.
        n_rays: R.
        behind: distance in the world at which light that nothing stops counts as stopped.
        threshold: samples with less alpha, or less weight, are skipped.
        distances: in the world, ``[N]``, of samples at ``t`` ``[N]`` on rays ``[N]``.
        shade: latents ``[N, k]`` of samples, given their indices ``[N]`` and rays ``[N]``; asked of those with weight.
    """
    keep = (optical_depth.detach() > -math.log1p(-threshold)).nonzero().squeeze(1)
    optical_depth, t, ray_index = taken(keep, optical_depth, t, ray_index)
    weights, transmittance = volume_weights(optical_depth, ray_index, n_rays)
    with torch.no_grad():
        depth = segment_sums(weights * distances(t, ray_index), ray_index, n_rays)
        depth += transmittance * behind

    seen = (weights.detach() > threshold).nonzero().squeeze(1)
    weights, t, ray_index, keep = taken(seen, weights, t, ray_index, keep)
    latent = shade(keep, ray_index)
    rendered = segment_sums(weights[:, None] * latent, ray_index, n_rays) + transmittance[:, None] * background
    return rendered, depth, Samples(latent, weights, t, ray_index, transmittance)


def distortion_and_occlusion(
    samples: Samples, n_rays: int, near: float, far: float, stride: float, *, apart: float, close: float
) -> dict[str, Tensor]:
    """Compute the distortion loss and the weight near the cameras, as shares of the way from near to far.

    Args:
        samples: of ``n_rays`` rays.
        near, far, stride: of the field's rays, and between samples along them.
        apart, close: weights of :func:`~ctm_plugin.rays.volume.distortion` and of
            :func:`~ctm_plugin.rays.volume.occlusion`; 0: not computed.
    """
    whole, terms = far - near, {}
    along = (samples.t - near) / whole
    if apart:
        found = distortion(samples.weights, along, samples.ray_index, n_rays, stride / whole)
        terms["distortion"] = apart * found
    if close:
        terms["occlusion"] = close * occlusion(samples.weights, along, n_rays)
    return terms


def taken(keep: Tensor, *tables: Tensor) -> tuple[Tensor, ...]:
    """Rows of tables ``[M, ...]`` at ``keep`` ``[N]``; the tables themselves where all are kept.

    ``index_select`` as indexing takes two to three times as long, and out of columns, as points are, twenty times.
    """
    if len(keep) == len(tables[0]):
        return tables
    return tuple(
        table.T.index_select(1, keep).T if table.ndim == 2 and table.T.is_contiguous() else table.index_select(0, keep)
        for table in tables
    )


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

    def forward(self, features: Tensor, directions: Tensor, ray_index: Tensor) -> Tensor:
        """``[M, features]``, ``[R, 3]``, ``[M]`` to ``[M, channels]`` in [0, 1]."""
        embedded = self.embed(directions)
        if features.device.type != "cpu":
            return self.whole(features, embedded, ray_index)
        entry, layers = FeaturesAndDirections(embedded.to(product_dtype(features)), ray_index), self.layers[::2]
        return blocked_mlp(features, entry, [layer.weight for layer in layers], [layer.bias for layer in layers])

    def whole(self, features: Tensor, embedded: Tensor, ray_index: Tensor) -> Tensor:
        """All samples in one go, for autograd: what GPUs run, and what tests compare the blocks with.

        ``[M, features]``, embedded directions ``[R, E]``, ``[M]`` to ``[M, channels]``.
        """
        return self.layers(torch.cat([features, embedded[ray_index]], dim=-1)).float().sigmoid()


class FeaturesAndDirections:
    """The entry of features ``[M, features]``: they and the embedded direction of their rays.

    See :class:`ctm_plugin.cpu.blocked_mlp.Entry`.

    Args:
        embedded: ``[R, E]``.
        ray_index: ``[M]``, on which ray each lies.
    """

    def __init__(self, embedded: Tensor, ray_index: Tensor):
        self.embedded, self.ray_index = embedded, ray_index

    def enter(self, table: Tensor, at: slice, out: Tensor) -> None:
        """Write features and directions side by side, ``[n, features + E]``."""
        features = table.shape[1]
        out[:, :features] = table
        out[:, features:] = self.embedded.index_select(0, self.ray_index[at])

    def leave(self, grad: Tensor, entered: Tensor) -> Tensor:
        """Keep the features' part, ``[n, features]``."""
        return grad[:, : -self.embedded.shape[1]]
