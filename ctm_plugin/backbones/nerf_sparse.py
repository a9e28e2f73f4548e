"""NeRF's network on a CPU: in blocks that stay in the cache, with a backward pass of the samples that matter.

A sample whose density is 0 has weight 0: its colour is seen by nobody, and its ReLU passes no gradient on. Once a scene
has taken shape that is most of space. So only density is evaluated everywhere; the colour layers, what is kept for the
backward pass, and the backward pass itself are only of the other samples, with the same result.
:func:`ctm_plugin.backbones.nerf_field.all_samples` is the same without any of that.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ctm_plugin.rays.encoding import embed

SAMPLE_BLOCK = 4096
"""Samples a block: 4 MiB of float32 at width 256."""
SAMPLE_MULTIPLE = 256
"""Samples with density are padded to a multiple of this: oneDNN keeps a kernel for every size that it ever met."""
RECOMPUTED_LAYERS = 2
"""Hidden layers that the backward pass computes anew, so that their outputs need no memory."""


class Layers(NamedTuple):
    """Weights of NeRF's network; those of the view layer are folded (:meth:`NeRFField.layers`).

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
        """Undo :meth:`flatten`, for the weights or for tensors of the same shapes, such as gradients."""
        depth = (len(tensors) - 7) // 2
        return cls(*tensors[:7], tuple(tensors[7 : 7 + depth]), tuple(tensors[7 + depth :]))

    def flatten(self) -> tuple[Tensor, ...]:
        """List all weights in one flat tuple: autograd does not look into nested ones."""
        return (*self[:7], *self.trunk, *self.biases)


class Kept:
    """Rows of the samples with density, for the backward pass: lists of tables ``[BLOCK, ...]``, the last of which are
    full up to ``filled``. Of one size, as an allocator that keeps its memory would end with gaps of all sizes.
    """

    def __init__(self) -> None:
        self.blocks: list[list[Tensor]] = []
        self.filled = SAMPLE_BLOCK

    def add(self, index: Tensor, every: Sequence[Tensor], chosen: Sequence[Tensor]) -> None:
        """Append N rows: those at ``index`` ``[N]`` of each table in ``every``, and all of each in ``chosen``."""
        start = 0
        while start < len(index):
            if self.filled == SAMPLE_BLOCK:
                self.blocks.append([table.new_empty(SAMPLE_BLOCK, *table.shape[1:]) for table in (*every, *chosen)])
                self.filled = 0
            stop = min(len(index), start + SAMPLE_BLOCK - self.filled)
            tables = [table[self.filled : self.filled + stop - start] for table in self.blocks[-1]]
            for table, source in zip(tables, every, strict=False):
                torch.index_select(source, 0, index[start:stop], out=table)
            for table, source in zip(tables[len(every) :], chosen, strict=True):
                table.copy_(source[start:stop])
            self.filled += stop - start
            start = stop

    def __iter__(self) -> Iterator[list[Tensor]]:
        for block in self.blocks[:-1]:
            yield block
        for block in self.blocks[-1:]:
            yield [table[: self.filled] for table in block]


def blocks_of_samples(
    points: Tensor, noise: Tensor | None, frequencies: Tensor, layers: Layers, skip: int
) -> tuple[Tensor, Tensor]:
    """Evaluate density ``[R, S]`` and latent ``[R, S, k]``, 0 where there is no density.

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
    """Cast the weights to the products' type, contiguous; biases added after the last products keep their own."""
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
        step = max(1, SAMPLE_BLOCK // samples)
        ctx.layers, ctx.skip, ctx.samples, ctx.kept = layers, skip, samples, Kept()
        for start in range(0, rays, step):
            rows = slice(start, start + step)
            embedded = embed(points[rows].flatten(0, 1), frequencies).to(dtype)
            hidden = _trunk(embedded, layers, skip)
            raw = (hidden[-1] @ layers.density[0]).to(points.dtype) + layers.density_bias
            raw = raw if noise is None else raw.add_(noise[rows].flatten())
            density[rows] = raw.view(-1, samples).relu_()
            active = _active(raw)
            sample = start * samples + active
            last = hidden[-1][active]
            seen = F.linear(last, layers.view).add_(layers.side[sample.div(samples, rounding_mode="floor")]).relu_()
            shown = (F.linear(seen, layers.color).to(points.dtype) + layers.color_bias).sigmoid_()
            latent.flatten(0, 1)[sample] = shown
            if keep:
                ctx.kept.add(active, [embedded, *hidden[RECOMPUTED_LAYERS:-1]], [last, seen, shown, sample])
        ctx.empty = density == 0
        return density, latent

    @staticmethod
    def backward(ctx, of_density, of_latent):
        layers, of_density = ctx.layers, of_density.masked_fill(ctx.empty, 0)
        grads = Layers.unflatten([torch.zeros_like(tensor, dtype=of_density.dtype) for tensor in layers.flatten()])
        again = min(RECOMPUTED_LAYERS, len(layers.trunk) - 1)  # the last one is always kept
        for embedded, *hidden, seen, latent, sample in ctx.kept:
            hidden = _trunk(embedded, layers, ctx.skip, again) + hidden
            ray = sample.div(ctx.samples, rounding_mode="floor")
            of_sample = of_density.flatten()[sample], of_latent.flatten(0, 1)[sample]
            _block_backward(embedded, hidden, seen, latent, ray, of_sample, layers, ctx.skip, grads)
        return None, None, None, None, None, None, *grads.flatten()


def _active(density: Tensor) -> Tensor:
    """Indices of the samples with density ``[M]``, and of others up to a multiple of ``SAMPLE_MULTIPLE``."""
    solid, empty = (part.nonzero().squeeze(1) for part in (density > 0, density <= 0))
    return torch.cat([solid, empty[: -len(solid) % SAMPLE_MULTIPLE]])


def _trunk(embedded: Tensor, layers: Layers, skip: int, stop: int | None = None) -> list[Tensor]:
    """Evaluate the first ``stop`` hidden layers, by default all, each ``[N, W]``, of embeddings ``[N, E]``."""
    hidden = []
    for index, (weight, bias) in enumerate(zip(layers.trunk[:stop], layers.biases[:stop], strict=True)):
        out = F.linear(hidden[-1] if hidden else embedded, weight, bias)
        if index == skip:
            out.addmm_(embedded, layers.skip.T)
        hidden.append(out.relu_())
    return hidden


def _block_backward(
    embedded: Tensor, hidden: list[Tensor], seen: Tensor, latent: Tensor, ray: Tensor,
    of_sample: tuple[Tensor, Tensor], layers: Layers, skip: int, grads: Layers,
) -> None:  # fmt: skip
    """Add to ``grads`` the weights' gradients from N samples, given those of densities and latents, ``of_sample``."""
    dtype, threshold_backward = layers.view.dtype, torch.ops.aten.threshold_backward  # before a ReLU, of what came out
    density, logits = of_sample[0], of_sample[1] * latent * (1 - latent)
    grads.color_bias.add_(logits.sum(0))
    grads.density_bias.add_(density.sum())
    logits, density = logits.to(dtype), density.to(dtype)
    grads.color.add_(logits.T @ seen)
    grad = threshold_backward(logits @ layers.color, seen, 0)
    grads.side.index_add_(0, ray, grad.to(grads.side.dtype))
    grads.view.add_(grad.T @ hidden[-1])
    grads.density.add_(density @ hidden[-1])
    grad = torch.addcmul(grad @ layers.view, density[:, None], layers.density)
    for index in range(len(layers.trunk) - 1, -1, -1):
        grad = threshold_backward(grad, hidden[index], 0)
        grads.biases[index].add_(grad.sum(0, dtype=grads.view.dtype))
        grads.trunk[index].add_(grad.T @ (hidden[index - 1] if index else embedded))
        if index == skip:
            grads.skip.add_(grad.T @ embedded)
        if index:
            grad = grad @ layers.trunk[index]
