"""An MLP on a sinusoidal embedding, with its gradients written out: the small layers of a colour transform."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def embed(color: Tensor, scale: float, frequencies: int) -> Tensor:
    """``[..., C (1 + 2 P)]``: ``gamma(c) = [c, sin(2^p scale c), cos(2^p scale c)]``, p = 0..P-1 (paper, Eq. 7).

    All sines by rising frequency, then all cosines.
    """
    angles = [scale * 2**index * color for index in range(frequencies)]
    return torch.cat([color, *(angle.sin() for angle in angles), *(angle.cos() for angle in angles)], dim=-1)


def embed_rows(color: Tensor, scale: float, frequencies: int) -> Tensor:
    """:func:`embed` of ``[N, C]``, turned: ``[C (1 + 2 P), N]``. No gradients.

    Angles are doubled: ``sin 2x = 2 sin x cos x``, ``cos 2x = 1 - 2 sin^2 x``. An angle's own rounding doubles from one
    frequency to the next as well, so that nothing is lost.
    """
    count, channels = color.shape
    table = color.new_empty(channels * (1 + 2 * frequencies), count)
    table[:channels] = color.T
    sines, cosines = _waves(table, channels, frequencies)
    if frequencies:
        angle = table[:channels] * scale
        torch.sin(angle, out=sines[0])
        torch.cos(angle, out=cosines[0])
    for low in range(frequencies - 1):
        torch.mul(sines[low], cosines[low], out=sines[low + 1]).mul_(2)
        torch.mul(sines[low], sines[low], out=cosines[low + 1]).mul_(-2).add_(1)
    return table


def sinusoidal_mlp(
    color: Tensor, scale: float, frequencies: int, weights: Sequence[Tensor], biases: Sequence[Tensor]
) -> Tensor:
    """``[N, out]`` in [0, 1]: :func:`embed`, linear layers with ReLU between them, a sigmoid.

    The same as these operators one by one, in fewer launches; gradients of gradients are not given.

    Args:
        color: ``[N, C]``.
        scale, frequencies: of the embedding.
        weights, biases: of the layers, ``[out, in]`` and ``[out]``.
    """
    return _SinusoidalMLP.apply(color, scale, frequencies, *weights, *biases)


class _SinusoidalMLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx, color, scale, frequencies, *layers):
        depth = len(layers) // 2
        weights, biases = layers[:depth], layers[depth:]
        inputs = [embed_rows(color, scale, frequencies).T]
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            inputs.append(torch.addmm(bias, inputs[-1], weight.T).relu_())
        out = torch.addmm(biases[-1], inputs[-1], weights[-1].T).sigmoid_()
        ctx.save_for_backward(out, *weights, *inputs)
        ctx.scale, ctx.frequencies, ctx.channels = scale, frequencies, color.shape[1]
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, of_out):
        out, *saved = ctx.saved_tensors
        depth = len(saved) // 2
        weights, inputs = saved[:depth], saved[depth:]
        of_weights, of_biases = [], []
        with torch.autocast(out.device.type, enabled=False):
            grad = torch.ops.aten.sigmoid_backward(of_out, out)
            for index in range(depth - 1, -1, -1):
                of_weights.insert(0, grad.T @ inputs[index])
                of_biases.insert(0, grad.sum(0))
                if index:
                    grad = torch.ops.aten.threshold_backward(grad @ weights[index], inputs[index], 0)
            of_color = None
            if ctx.needs_input_grad[0]:
                of_color = _of_color(weights[0].T @ grad.T, inputs[0].T, ctx)
        return of_color, None, None, *of_weights, *of_biases


def _of_color(grad: Tensor, table: Tensor, ctx: torch.autograd.function.FunctionCtx) -> Tensor:
    """The colour's gradient ``[N, C]``, of that of :func:`embed_rows`, which is used up."""
    of_sines, of_cosines = _waves(grad, ctx.channels, ctx.frequencies)
    sines, cosines = _waves(table, ctx.channels, ctx.frequencies)
    of_angles = of_sines.mul_(cosines).addcmul_(of_cosines, sines, value=-1)
    of_color = grad[: ctx.channels]
    for index in range(ctx.frequencies):
        of_color.add_(of_angles[index], alpha=ctx.scale * 2**index)
    return of_color.T


def _waves(table: Tensor, channels: int, frequencies: int) -> tuple[Tensor, Tensor]:
    """Sines and cosines of a table, ``[P, C, N]`` each."""
    waves = table[channels:].view(2, frequencies, channels, table.shape[1])
    return waves[0], waves[1]
