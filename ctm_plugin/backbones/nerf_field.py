"""NeRF's network: positions and view directions to density and latent colour (Mildenhall et al., ECCV 2020)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ctm_plugin.backbones.nerf_sparse import Layers, blocks_of_samples
from ctm_plugin.rays.encoding import embed


class NeRFField(nn.Module):
    """NeRF's MLP: ``depth`` ReLU layers on the embedded position; layer ``skip`` (from 0) sees the embedding again.

    Density is linear in the last of them, then ReLU. The latent has one more ReLU layer of half the width, on a linear
    feature of the last layer joined with the embedded direction, then a sigmoid.

    Args:
        channels: number k of latent channels.
        width, depth, skip: units a layer, number of layers, and the skip layer; 1 <= skip < depth.
        position_frequencies, direction_frequencies: number of frequencies of the two embeddings.
    """

    def __init__(
        self,
        channels: int,
        width: int = 256,
        depth: int = 8,
        skip: int = 5,
        position_frequencies: int = 10,
        direction_frequencies: int = 4,
    ):
        super().__init__()
        self.register_buffer("position_frequencies", 2.0 ** torch.arange(position_frequencies), persistent=False)
        self.register_buffer("direction_frequencies", 2.0 ** torch.arange(direction_frequencies), persistent=False)
        self.skip = skip
        position, direction = 3 + 6 * position_frequencies, 3 + 6 * direction_frequencies
        inputs = [position] + [width] * (depth - 1)
        inputs[skip] += position
        self.trunk = nn.ModuleList(nn.Linear(size, width) for size in inputs)
        self.density = nn.Linear(width, 1)
        self.feature = nn.Linear(width, width)
        self.view = nn.Linear(width + direction, width // 2)
        self.color = nn.Linear(width // 2, channels)
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                nn.init.xavier_uniform_(layer.weight)
                nn.init.zeros_(layer.bias)
        # Some networks would start without any density, and the ReLU would keep them so for ever.
        nn.init.constant_(self.density.bias, 0.3)

    def forward(self, points: Tensor, directions: Tensor, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Evaluate density and latent, float32 (float64 of a float64 field), whatever autocast does to products inside.

        Args:
            points: ``[R, S, 3]``, no gradient flows into them.
            directions: ``[R, 3]``, unit length, of the world.
            noise: ``[R, S]`` added to the density before its ReLU.

        Returns:
            ``[R, S]`` >= 0 and ``[R, S, k]`` in [0, 1]; latents of samples without density are not defined, as their
            weight is 0.
        """
        query = blocks_of_samples if points.device.type == "cpu" else all_samples
        return query(points, noise, self.position_frequencies, self.layers(directions), self.skip)

    def layers(self, directions: Tensor) -> Layers:
        """Fold the weights as the products take them, for rays with ``directions`` ``[R, 3]``.

        No non-linearity stands between ``feature`` and ``view``: they are one matrix, ``V_h W_f``, and what the view
        layer adds for a direction is the same for all samples of a ray.
        """
        size, width = self.trunk[0].in_features, self.feature.in_features
        weights = [layer.weight for layer in self.trunk]
        weights[self.skip] = self.trunk[self.skip].weight[:, size:]
        with torch.autocast(directions.device.type, enabled=False):
            of_feature, of_direction = self.view.weight[:, :width], self.view.weight[:, width:]
            bias = self.view.bias + of_feature @ self.feature.bias
            side = embed(directions, self.direction_frequencies) @ of_direction.T + bias
            view = of_feature @ self.feature.weight
        return Layers(
            side=side,
            view=view,
            skip=self.trunk[self.skip].weight[:, :size],
            density=self.density.weight,
            density_bias=self.density.bias,
            color=self.color.weight,
            color_bias=self.color.bias,
            trunk=tuple(weights),
            biases=tuple(layer.bias for layer in self.trunk),
        )


def all_samples(
    points: Tensor, noise: Tensor | None, frequencies: Tensor, layers: Layers, skip: int
) -> tuple[Tensor, Tensor]:
    """Evaluate every sample in one go: no shape depends on the data, so that a GPU never waits for the host.

    Arguments and results are those of :func:`ctm_plugin.backbones.nerf_sparse.blocks_of_samples`.
    """
    embedded = embed(points, frequencies)
    hidden = embedded
    for index, (weight, bias) in enumerate(zip(layers.trunk, layers.biases, strict=True)):
        hidden = F.linear(hidden, weight, bias)
        if index == skip:
            hidden = hidden + F.linear(embedded, layers.skip)
        hidden = hidden.relu_()
    density = F.linear(hidden, layers.density, layers.density_bias).squeeze(-1).to(points.dtype)
    seen = (F.linear(hidden, layers.view) + layers.side[:, None]).relu_()
    latent = F.linear(seen, layers.color, layers.color_bias).to(points.dtype).sigmoid()
    return (density if noise is None else density + noise).relu(), latent
