"""The small networks of fields on grids: features to a density, features and a view direction to a latent."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from ctm_plugin.cpu.blocked_mlp import blocked_mlp, product_dtype
from ctm_plugin.rays.encoding import embed
from ctm_plugin.rays.spherical_harmonics import harmonics


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
        """``forward`` without blocks, ``[M, channels]``: run on GPUs, and by tests that compare the blocks with it."""
        return self.layers(torch.cat([features, embedded[ray_index]], dim=-1)).float().sigmoid()


class ViewMLP(DirectedMLP):
    """DVGO's: the direction d is embedded as ``[d, sin(2^p d), cos(2^p d)]``, p = 0..frequencies-1."""

    def __init__(self, features: int, channels: int, width: int, depth: int, frequencies: int):
        super().__init__(features, 3 * (1 + 2 * frequencies), channels, width, depth)
        self.register_buffer("frequencies", 2.0 ** torch.arange(frequencies), persistent=False)

    def embed(self, directions: Tensor) -> Tensor:
        return embed(directions, self.frequencies)


class HarmonicMLP(DirectedMLP):
    """NGP's: the direction becomes ``degrees`` degrees of spherical harmonics."""

    def __init__(self, features: int, channels: int, width: int, depth: int, degrees: int):
        super().__init__(features, degrees**2, channels, width, depth)
        self.degrees = degrees

    def embed(self, directions: Tensor) -> Tensor:
        return harmonics(directions, self.degrees)


class FeaturesAndDirections:
    """The entry of features: they and the embedded direction of their rays, see :mod:`ctm_plugin.cpu.blocked_mlp`.

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


class AsItIs:
    """The entry of a table that a network takes as it is."""

    def enter(self, table: Tensor, at: slice, out: Tensor) -> None:
        """Write the rows, ``[n, D]``."""
        out.copy_(table)

    def leave(self, grad: Tensor, entered: Tensor) -> Tensor:
        """Keep it, ``[n, D]``."""
        return grad


class DensityMLP(nn.Module):
    """Features ``[M, F]`` to ``[M, outputs]``: one hidden layer with a ReLU, the last one linear."""

    def __init__(self, features: int, width: int, outputs: int):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(features, width), nn.ReLU(), nn.Linear(width, outputs))
        nn.init.zeros_(self.layers[-1].bias)

    def forward(self, features: Tensor) -> Tensor:
        if features.device.type != "cpu":
            return self.layers(features).float()
        weights, biases = zip(*((layer.weight, layer.bias) for layer in self.layers[::2]), strict=True)
        return blocked_mlp(features, AsItIs(), weights, biases, sigmoid=False)
