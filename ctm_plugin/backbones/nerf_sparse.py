"""NeRF's network on a CPU: in blocks that stay in the cache, with a backward pass of the samples that matter.

A sample whose density is 0 has weight 0: its colour is seen by nobody, and its ReLU passes no gradient on. Once a scene
has taken shape that is most of space. So only density is evaluated everywhere; the colour layers, what is kept for the
backward pass, and the backward pass itself are of the other samples alone, with the same result.
:meth:`ctm_plugin.backbones.nerf_field.NeRFField._all_samples` is the same without any of that.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ctm_plugin.rays.encoding import embed

BLOCK = 4096
"""Samples a block: 4 MiB of float32 at width 256."""


class Layers(NamedTuple):
    """Weights of the network, the view layer's folded.

    Attributes:
        side: ``[R, V]``, what the view layer adds for each ray: its direction's part and its bias.
        view: ``[V, W]``, from the last hidden layer.
        skip: ``[W, E]``, from the embedding to the skip layer.
        density, density_bias, color, color_bias: the two outputs' layers.
        trunk, biases: of the hidden layers, the skip layer's without the part in ``skip``.
    """

    side: Tensor
    view: Tensor
    skip: Tensor
    density: Tensor
    density_bias: Tensor
    color: Tensor
    color_bias: Tensor
    trunk: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]

    @classmethod
    def unflatten(cls, tensors: Sequence[Tensor]) -> Layers:
        depth = (len(tensors) - 7) // 2
        return cls(*tensors[:7], tuple(tensors[7 : 7 + depth]), tuple(tensors[7 + depth :]))

    def flatten(self) -> tuple[Tensor, ...]:
        return (*self[:7], *self.trunk, *self.biases)


class Kept(NamedTuple):
    """Of one block, for its backward pass; N of its samples have density.

    Attributes:
        active: their indices in the block.
        ray: the ray of each.
        embedded: ``[N, E]``.
        hidden: ``[N, W]`` of each hidden layer but the first, which is cheap to have again.
        seen: ``[N, V]``, the view layer.
        latent: ``[N, k]``.
    """

    active: Tensor
    ray: Tensor
    embedded: Tensor
    hidden: list[Tensor]
    seen: Tensor
    latent: Tensor


def query(
    points: Tensor, noise: Tensor | None, frequencies: Tensor, layers: Layers, skip: int
) -> tuple[Tensor, Tensor]:
    """Density ``[R, S]`` and latent ``[R, S, k]``, 0 where there is no density.

    Products are of autocast's type where it is on, all else is of the points'.

    Args:
        points: ``[R, S, 3]``.
        noise: ``[R, S]`` added to the density before its ReLU.
        frequencies: of the embedding.
        layers: the weights.
        skip: index of the hidden layer that sees the embedding again.
    """
    dtype = torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else points.dtype
    keep = torch.is_grad_enabled()
    return _Query.apply(points, noise, frequencies, skip, dtype, keep, *layers.flatten())


def _in_type(layers: Layers, dtype: torch.dtype) -> Layers:
    """Contiguous, of the products' type; what is added after the last product of a kind keeps its own."""
    flat = [tensor.to(dtype).contiguous() for tensor in layers.flatten()]
    return Layers.unflatten(flat)._replace(
        side=layers.side, density_bias=layers.density_bias, color_bias=layers.color_bias
    )


class _Query(torch.autograd.Function):
    @staticmethod
    def forward(ctx, points, noise, frequencies, skip, dtype, keep, *flat):
        layers = _in_type(Layers.unflatten(flat), dtype)
        rays, samples, _ = points.shape
        density = points.new_empty(rays, samples)
        latent = points.new_zeros(rays, samples, len(layers.color))
        step = max(1, BLOCK // samples)
        ctx.layers, ctx.skip, ctx.step, ctx.kept = layers, skip, step, []
        for start in range(0, rays, step):
            rows = slice(start, start + step)
            embedded = embed(points[rows].flatten(0, 1), frequencies).to(dtype)
            hidden = _trunk(embedded, layers, skip)
            raw = (hidden[-1] @ layers.density[0]).to(points.dtype) + layers.density_bias
            raw = raw if noise is None else raw.add_(noise[rows].flatten())
            density[rows] = raw.view(-1, samples).relu_()
            active = (raw > 0).nonzero().squeeze(1)
            if not len(active):
                ctx.kept.append(None)
                continue
            whole = len(active) == len(raw)
            ray = start + active.div(samples, rounding_mode="floor")
            last = hidden[-1] if whole else hidden[-1][active]
            seen = F.linear(last, layers.view).add_(layers.side[ray]).relu_()
            shown = (F.linear(seen, layers.color).to(points.dtype) + layers.color_bias).sigmoid_()
            latent[rows].flatten(0, 1)[active] = shown
            if keep:
                between = hidden[1:-1] if whole else [layer[active] for layer in hidden[1:-1]]
                embedded = embedded if whole else embedded[active]
                ctx.kept.append(Kept(active, ray, embedded, [*between, last], seen, shown))
        return density, latent

    @staticmethod
    def backward(ctx, of_density, of_latent):
        layers = ctx.layers
        grads = Layers.unflatten([torch.zeros_like(tensor, dtype=of_density.dtype) for tensor in layers.flatten()])
        for index, kept in enumerate(ctx.kept):
            if kept is not None:
                rows = slice(index * ctx.step, (index + 1) * ctx.step)
                density, latent = of_density[rows].flatten()[kept.active], of_latent[rows].flatten(0, 1)[kept.active]
                _block_backward(kept, density, latent, layers, ctx.skip, grads)
        return None, None, None, None, None, None, *grads.flatten()


def _trunk(embedded: Tensor, layers: Layers, skip: int) -> list[Tensor]:
    hidden = []
    for index, (weight, bias) in enumerate(zip(layers.trunk, layers.biases, strict=True)):
        out = F.linear(hidden[-1] if hidden else embedded, weight, bias)
        if index == skip:
            out.addmm_(embedded, layers.skip.T)
        hidden.append(out.relu_())
    return hidden


def _block_backward(kept: Kept, density: Tensor, latent: Tensor, layers: Layers, skip: int, grads: Layers) -> None:
    """Add a block's gradients, given those of its active samples' densities ``[N]`` and latents ``[N, k]``."""
    dtype = layers.view.dtype
    hidden = [F.linear(kept.embedded, layers.trunk[0], layers.biases[0]).relu_(), *kept.hidden]
    logits = latent * kept.latent * (1 - kept.latent)
    grads.color_bias.add_(logits.sum(0))
    grads.density_bias.add_(density.sum())
    logits, raw = logits.to(dtype), density.to(dtype)
    grads.color.add_(logits.T @ kept.seen)
    seen = _through_relu(logits @ layers.color, kept.seen)
    grads.side.index_add_(0, kept.ray, seen.to(grads.side.dtype))
    grads.view.add_(seen.T @ hidden[-1])
    grads.density.add_(raw @ hidden[-1])
    grad = torch.addcmul(seen @ layers.view, raw[:, None], layers.density)
    for index in range(len(layers.trunk) - 1, -1, -1):
        grad = _through_relu(grad, hidden[index])
        grads.biases[index].add_(grad.sum(0, dtype=grads.view.dtype))
        grads.trunk[index].add_(grad.T @ (hidden[index - 1] if index else kept.embedded))
        if index == skip:
            grads.skip.add_(grad.T @ kept.embedded)
        if index:
            grad = grad @ layers.trunk[index]


def _through_relu(grad: Tensor, out: Tensor) -> Tensor:
    """The gradient before a ReLU, of what came out of it."""
    return torch.ops.aten.threshold_backward(grad, out, 0)
