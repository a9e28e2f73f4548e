"""A picture as a network: positions to latent colours (Lin et al., BARF, ICCV 2021, Section 4.1)."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ctm_plugin.cpu.blocked_mlp import Entry, blocked_mlp, product_dtype
from ctm_plugin.rays.encoding import embed


class NeuralImage(nn.Module):
    """A picture as an MLP: ``depth`` ReLU layers on the embedded position, then a linear layer and a sigmoid.

    Args:
        channels: number k of latent channels.
        width, depth: units of a hidden layer, and number of hidden layers.
        frequencies: P of the embedding ``[x, sin(2^p pi x), cos(2^p pi x)]``; 0: the plain position.
        rescale: multiply the first layer's start by ``sqrt(inputs / 2)``, as only two of its inputs are used at first.
    """

    def __init__(self, channels: int, width: int = 256, depth: int = 4, frequencies: int = 8, rescale: bool = False):
        super().__init__()
        self.register_buffer("frequencies", math.pi * 2.0 ** torch.arange(frequencies), persistent=False)
        inputs = 2 + 4 * frequencies
        sizes = [inputs] + [width] * depth + [channels]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        if rescale:
            with torch.no_grad():
                for parameter in self.layers[0].parameters():
                    parameter.mul_(math.sqrt(inputs / 2))

    def forward(self, points: Tensor, shown: Tensor | None = None) -> Tensor:
        """Evaluate latents ``[N, k]`` in [0, 1], float32 (float64 of a float64 network), whatever autocast does inside.

        Args:
            points: ``[N, 2]``; gradients flow into them.
            shown: ``[P]`` weight of each frequency; ``None``: 1 for all.
        """
        weights, biases = [layer.weight for layer in self.layers], [layer.bias for layer in self.layers]
        if shown is not None:
            # On the weights instead of the embedding: the same product, far fewer numbers.
            each = shown.repeat_interleave(2)
            weights[0] = weights[0] * torch.cat([torch.ones_like(each[:2]), each, each])
        if points.device.type == "cpu":
            if product_dtype(points) != points.dtype:
                weights[0] = torch.cat([weights[0][:, :2], weights[0]], dim=1)
            return blocked_mlp(points, EmbeddedPositions(self.frequencies), weights, biases)
        return self._whole(points, weights, biases)

    def _whole(self, points: Tensor, weights: list[Tensor], biases: list[Tensor]) -> Tensor:
        """Evaluate all points in one go, for autograd: for GPUs, and as the reference of the CPU's blocks."""
        hidden = embed(points, self.frequencies)
        # Positions in bfloat16 would be half a pixel off.
        with torch.autocast(points.device.type, enabled=False):
            hidden = F.linear(hidden, weights[0], biases[0]).relu_()
        for weight, bias in zip(weights[1:-1], biases[1:-1], strict=True):
            hidden = F.linear(hidden, weight, bias).relu_()
        return F.linear(hidden, weights[-1], biases[-1]).to(points.dtype).sigmoid()


class EmbeddedPositions(Entry):
    """Input of a blocked MLP: the embedding of positions ``[N, 2]``. In half precision the positions' rounding errors
    stand in two columns before it, which keeps 16 bits of them in bfloat16.

    Args:
        frequencies: ``[P]`` of the embedding.
    """

    def __init__(self, frequencies: Tensor):
        self.frequencies = frequencies

    def enter(self, table: Tensor, at: slice, out: Tensor) -> None:
        embedded = embed(table, self.frequencies)
        out[:, -embedded.shape[1] :] = embedded
        if out.dtype != table.dtype:
            out[:, :2] = table - out[:, 2:4]

    def leave(self, grad: Tensor, entered: Tensor) -> Tensor:
        frequencies = self.frequencies
        waves = 2 * len(frequencies)
        first = grad.shape[1] - 2 * waves  # of the sines; the positions come before them
        grad, entered = grad.to(frequencies.dtype), entered.to(frequencies.dtype)
        (of_sin, of_cos), (sin, cos) = (
            (part[:, first : first + waves], part[:, first + waves :]) for part in (grad, entered)
        )
        slopes = (of_sin * cos - of_cos * sin).unflatten(1, (-1, 2)) * frequencies[:, None]
        return grad[:, first - 2 : first] + slopes.sum(1)


def shown_frequencies(count: int, progress: float, start: float, end: float, device: torch.device) -> Tensor:
    """Weigh frequencies ``[P]``: ``(1 - cos(pi clamp(a - p, 0, 1))) / 2``, p = 0..P-1, a rising from 0 at ``start`` of
    the training to P at ``end``.

    Source: BARF, Eq. 14, with P = ``count``.
    """
    a = count * (progress - start) / (end - start)
    return (1 - ((a - torch.arange(count, device=device)).clamp(0, 1) * math.pi).cos()) / 2
