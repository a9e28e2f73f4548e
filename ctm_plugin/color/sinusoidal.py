"""An MLP on a sinusoidal embedding, with its gradients written out: the small layers of a colour transform."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def embed(color: Tensor, rates: Tensor) -> Tensor:
    """``[..., C (1 + 2 P)]``: ``gamma(c) = [c, sin(r c), cos(r c)]`` for the rates r, ``[P]`` (paper, Eq. 7).

    All sines, rate by rate, then all cosines.
    """
    angles = (color[..., None, :] * rates[:, None]).flatten(-2)
    return torch.cat([color, angles.sin(), angles.cos()], dim=-1)


def embed_rows(color: Tensor, rates: Tensor) -> Tensor:
    """:func:`embed` of ``[N, C]``, turned: ``[C (1 + 2 P), N]``. No gradients."""
    count, channels = color.shape
    table = color.new_empty(channels * (1 + 2 * len(rates)), count)
    table[:channels] = color.T
    sines, angles = _waves(table, channels)
    torch.mul(rates[:, None, None], table[:channels], out=angles)
    torch.sin(angles, out=sines)
    angles.cos_()
    return table


def sinusoidal_mlp(color: Tensor, rates: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    """``[N, out]`` in [0, 1]: :func:`embed`, linear layers with ReLU between them, a sigmoid.

    The same as these operators one by one, in fewer launches; gradients of gradients are not given, nor the rates'.

    Args:
        color: ``[N, C]``.
        rates: ``[P]``, of the embedding.
        weights, biases: of the layers, ``[out, in]`` and ``[out]``.
    """
    return _SinusoidalMLP.apply(color, rates, *weights, *biases)


class _SinusoidalMLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx, color, rates, *layers):
        depth = len(layers) // 2
        weights, biases = layers[:depth], layers[depth:]
        inputs = [embed_rows(color, rates).T]
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            inputs.append(torch.addmm(bias, inputs[-1], weight.T).relu_())
        out = torch.addmm(biases[-1], inputs[-1], weights[-1].T).sigmoid_()
        ctx.save_for_backward(out, rates, *weights, *inputs)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, of_out):
        out, rates, *saved = ctx.saved_tensors
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
                of_color = _of_color(weights[0].T @ grad.T, inputs[0].T, rates)
        return of_color, None, *of_weights, *of_biases


def _of_color(grad: Tensor, table: Tensor, rates: Tensor) -> Tensor:
    """The colour's gradient ``[N, C]``, of that of :func:`embed_rows`, which is used up."""
    channels = len(table) // (1 + 2 * len(rates))
    of_sines, of_cosines = _waves(grad, channels)
    sines, cosines = _waves(table, channels)
    of_angles = of_sines.mul_(cosines).addcmul_(of_cosines, sines, value=-1)
    direct = grad[:channels]
    return torch.addmv(direct.flatten(), of_angles.flatten(1).T, rates).view_as(direct).T


def _waves(table: Tensor, channels: int) -> tuple[Tensor, Tensor]:
    """Sines and cosines of a table, ``[P, C, N]`` each."""
    waves = table[channels:].view(2, len(table) // channels // 2, channels, table.shape[1])
    return waves[0], waves[1]
