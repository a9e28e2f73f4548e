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
        features: number of a sample's features.
        embedded: size of a direction's embedding.
        channels: number k of latent channels.
        width, depth: units of a hidden layer, and number of linear layers.
    """

    def __init__(self, features: int, embedded: int, channels: int, width: int, depth: int):
        super().__init__()
        sizes = [features + embedded] + [width] * (depth - 1)
        hidden = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.ReLU(inplace=True))]
        self.layers = nn.Sequential(*hidden, nn.Linear(sizes[-1], channels))
        nn.init.zeros_(self.layers[-1].bias)

    def embed(self, directions: Tensor) -> Tensor:
        """Embed view directions ``[R, 3]``, unit length: ``[R, embedded]``."""
        raise NotImplementedError

    def forward(self, features: Tensor, directions: Tensor, ray_index: Tensor) -> Tensor:
        """Evaluate latents ``[M, channels]`` in [0, 1] of features ``[M, features]`` along directions ``[R, 3]``.

        ``ray_index`` ``[M]`` has each sample's row of ``directions``, which have unit length.
        """
        embedded = self.embed(directions)
        if features.device.type != "cpu":
            return self.whole(features, embedded, ray_index)
        entry, layers = FeaturesAndDirections(embedded.to(product_dtype(features)), ray_index), self.layers[::2]
        return blocked_mlp(features, entry, [layer.weight for layer in layers], [layer.bias for layer in layers])

    def whole(self, features: Tensor, embedded: Tensor, ray_index: Tensor) -> Tensor:
        """Evaluate ``forward`` in one go, ``[M, channels]``: for GPUs, and as the reference of the CPU's blocks."""
        return self.layers(torch.cat([features, embedded[ray_index]], dim=-1)).float().sigmoid()


class ViewMLP(DirectedMLP):
    """DVGO's colour network: the direction d is embedded as ``[d, sin(2^p d), cos(2^p d)]``, p = 0..frequencies-1."""

    def __init__(self, features: int, channels: int, width: int, depth: int, frequencies: int):
        super().__init__(features, 3 * (1 + 2 * frequencies), channels, width, depth)
        self.register_buffer("frequencies", 2.0 ** torch.arange(frequencies), persistent=False)

    def embed(self, directions: Tensor) -> Tensor:
        return embed(directions, self.frequencies)


class HarmonicMLP(DirectedMLP):
    """NGP's colour network: the direction is embedded as ``degrees`` degrees of spherical harmonics."""

    def __init__(self, features: int, channels: int, width: int, depth: int, degrees: int):
        super().__init__(features, degrees**2, channels, width, depth)
        self.degrees = degrees

    def embed(self, directions: Tensor) -> Tensor:
        return harmonics(directions, self.degrees)


class FeaturesAndDirections:
    """Input of a :mod:`ctm_plugin.cpu.blocked_mlp`: samples' features next to the embedded directions of their rays.

    Args:
        embedded: ``[R, E]`` embedded directions.
        ray_index: ``[M]``, on which ray each lies.
    """

    def __init__(self, embedded: Tensor, ray_index: Tensor):
        self.embedded, self.ray_index = embedded, ray_index

    def enter(self, table: Tensor, at: slice, out: Tensor) -> None:
        """Write features and embedded directions side by side into ``out``, ``[n, features + E]``."""
        features = table.shape[1]
        out[:, :features] = table
        out[:, features:] = self.embedded.index_select(0, self.ray_index[at])

    def leave(self, grad: Tensor, entered: Tensor) -> Tensor:
        """Give the features' part ``[n, features]`` of the input's gradient."""
        return grad[:, : -self.embedded.shape[1]]


class AsItIs:
    """Input of a :mod:`ctm_plugin.cpu.blocked_mlp` that is the table itself."""

    def enter(self, table: Tensor, at: slice, out: Tensor) -> None:
        """Copy the table's rows ``[n, D]`` into ``out``."""
        out.copy_(table)

    def leave(self, grad: Tensor, entered: Tensor) -> Tensor:
        """Give the input's gradient ``[n, D]`` unchanged: it is the table's."""
        return grad


class DensityMLP(nn.Module):
    """NGP's density network, features ``[M, F]`` to ``[M, outputs]``: a hidden ReLU layer, then a linear one."""

    def __init__(self, features: int, width: int, outputs: int):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(features, width), nn.ReLU(), nn.Linear(width, outputs))
        nn.init.zeros_(self.layers[-1].bias)

    def forward(self, features: Tensor) -> Tensor:
        if features.device.type != "cpu":
            return self.layers(features).float()
        weights, biases = zip(*((layer.weight, layer.bias) for layer in self.layers[::2]), strict=True)
        return blocked_mlp(features, AsItIs(), weights, biases, sigmoid=False)
