"""CTM's losses with their gradients, in one pass over the colours."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from ctm_plugin.cpu.compiled import compiled, function_at, fused_part
from ctm_plugin.cpu.ctm_networks import (
    LANES,
    ONE,
    ROW,
    TILE,
    TWO,
    ZERO,
    add,
    backward,
    clear,
    copy,
    count_of,
    empty_out,
    fill,
    forward,
    network,
    outputs,
    pack,
    unpack,
)

GROUPS = 64
"""Sums of gradients, at most: as many as there are tiles, so that nothing depends on the number of threads."""
ARGUMENTS = (
    "f4[:,::1], f4[:,::1], f4[:,::1], f4[:,:,::1], i8, f4, i8[:,::1], f4[::1], f4[::1], f4[::1], b1, "
    "f4[:,::1], f4[:,:,::1], f8[:,::1], f4[:,::1]"
)


def losses(
    encoder: nn.Module, decoder: nn.Module, given: Any, photometric: Any, weights: Any, reduction: str
) -> tuple[dict[str, Tensor], Tensor]:
    """Do as :func:`ctm_plugin.color.ctm.five_terms`."""
    latents, rgb, random, random_latent = given
    mean, factor = reduction == "mean", photometric.weight
    colors, channels = (3, random_latent.shape[1]) if mean else (1, 1)
    factors = {
        "enc": weights.enc * factor / (len(rgb) * channels),
        "dec": weights.dec * factor / (len(rgb) * colors),
        "img": weights.img / (len(rgb) * colors),
        "rand": weights.rand / (max(1, len(random)) * colors),
        "latent": weights.latent / (max(1, len(random_latent)) * channels),
    }
    *terms, target = CTMLosses.apply(
        (len(encoder.frequencies), encoder.scale), np.array([encoder.sizes, decoder.sizes]),
        np.array([*factors.values()], np.float32), photometric.kind == "l1",
        rgb.contiguous(), random, random_latent, len(latents), *latents,
        *(part for each in (encoder, decoder) for layer in each.linear for part in (layer.weight, layer.bias)),
    )  # fmt: skip
    skipped = () if latents else ("enc", "dec")
    named = zip(factors, terms, strict=True)
    return {name: term for name, term in named if getattr(weights, name) and name not in skipped}, target


class CTMLosses(torch.autograd.Function):
    """The five terms, and the encoded training colours.

    The gradients come with them, for the terms' sum; where a term's gradient is asked for, or a weighted one, the loops
    run once more.

    Args:
        embedding: the number of frequencies, and their scale.
        sizes: ``[2, layers + 1]``, of the encoder's embedding and its layers' outputs, and of the decoder's.
        factors: five, on the sums over rows and channels; terms of factor 0 are not computed.
        absolute: sum absolute differences in ``enc`` and ``dec``, not squared ones.
        rgb, random, random_latent: ``[R, 3]``, ``[S, 3]``, ``[T, k]``.
        count: how many of the tensors that follow are latents, ``[R, k]``.
        tensors: latents; weight and bias of each layer of the encoder, then of the decoder.
    """

    @staticmethod
    def forward(
        ctx: Any,
        embedding: tuple[int, float],
        sizes: np.ndarray,
        factors: np.ndarray,
        absolute: bool,
        rgb: Tensor,
        random: Tensor,
        random_latent: Tensor,
        count: int,
        *tensors: Tensor,
    ) -> tuple[Tensor, ...]:
        # Arrays of numpy from here on: so many small operations of torch's take as long as a thousand colours.
        latents, layers = tensors[:count], [layer.detach().numpy() for layer in tensors[count:]]
        stacked = np.empty((count, len(rgb), random_latent.shape[1]), np.float32)
        for latent, row in zip(latents, stacked, strict=True):
            row[:] = latent.detach().numpy()
        ctx.given, ctx.factors, ctx.layers = (stacked, *pack(layers), embedding, sizes, absolute), factors, layers
        ctx.save_for_backward(rgb, random, random_latent)
        terms, target, *ctx.gradients = _with_gradients(rgb, random, random_latent, factors, *ctx.given)
        target = torch.from_numpy(target)
        ctx.mark_non_differentiable(target)
        return *torch.from_numpy(terms).unbind(), target

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *of_outputs: Tensor) -> tuple[Tensor | None, ...]:
        colors, gradients, ctx.gradients = ctx.saved_tensors, ctx.gradients, None  # who gets them may write to them
        of_terms = [float(each) for each in of_outputs[:5]]
        computed = {of_term for of_term, factor in zip(of_terms, ctx.factors, strict=True) if factor}
        if gradients is None or len(computed) > 1:
            factors = ctx.factors * np.array(of_terms, np.float32)
            _, _, *gradients = _with_gradients(*colors, factors, *ctx.given)
        elif computed != {1.0}:
            of_sum = computed.pop() if computed else 0.0
            gradients = [each * np.float32(of_sum) for each in gradients]
        of_latents, of_packed = gradients
        return (None,) * 8 + (*map(torch.from_numpy, of_latents), *map(torch.from_numpy, unpack(of_packed, ctx.layers)))


def _with_gradients(
    rgb: Tensor,
    random: Tensor,
    random_latent: Tensor,
    factors: np.ndarray,
    latents: np.ndarray,
    packed: np.ndarray,
    turned: np.ndarray,
    embedding: tuple[int, float],
    sizes: np.ndarray,
    absolute: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Terms ``[5]``, target ``[R, k]``, and the gradients of the terms' sum for latents and packed layers."""
    groups = max(1, min(GROUPS, -(-max(len(rgb), len(random), len(random_latent)) // TILE)))
    target, of_latents = np.empty((len(rgb), random_latent.shape[1]), np.float32), np.empty_like(latents)
    terms, sums = np.empty((groups, 5)), np.zeros((groups, len(packed)), np.float32)
    _losses(
        _group.address(), rgb, random, random_latent, latents, *embedding, sizes, packed, turned, factors, absolute,
        target, of_latents, terms, sums,
    )  # fmt: skip
    return terms.sum(0).astype(np.float32), target, of_latents, sums.sum(0)


@fused_part
def _distance(a, b, rows, count, width, factor, absolute, of_a):
    """``factor`` times the sum of squared, or absolute, differences of two tiles' rows; sets the gradient of ``a``."""
    total = 0.0
    for c in range(rows):
        part = ZERO
        if absolute:
            for t in range(count):
                difference = a[c, t] - b[c, t]
                part += abs(difference)
                of_a[c, t] = factor * np.sign(difference)
        else:
            for t in range(count):
                difference = a[c, t] - b[c, t]
                part += difference * difference
                of_a[c, t] = TWO * factor * difference
        for t in range(count, width):
            of_a[c, t] = ZERO
        total += part
    return factor * total


@fused_part
def _tile(outer, inner, embedding, factors, absolute, inputs, renderings, start, stop, target, of_renderings, terms):
    """Rows ``start`` to ``stop``: ``| input - inner(outer(input)) |^2``, and ``| F - outer(input) |^2`` and
    ``| inner(F) - input |^2`` of each rendering ``F``.

    With the encoder as ``outer`` and training colours as inputs these are ``img``, ``enc`` and ``dec``; with random
    colours the first is ``rand``, and with the decoder as ``outer`` ``latent``.
    """
    (frequencies, scale), (of_enc, of_dec, of_cycle) = embedding, factors
    encoded, of_encoded = outputs(outer)
    decoded, of_decoded = outputs(inner)
    given, between, of_between = outer[4], inner[4], inner[5]
    channels, count = inner[0][0] // (1 + 2 * frequencies), stop - start
    width = (count + LANES - 1) // LANES * LANES
    of_rendering, of_all = np.zeros((channels, ROW), np.float32), np.zeros((channels, ROW), np.float32)
    fill(inputs, start, stop, width, given)
    forward(outer, frequencies, scale, width)
    if len(target):
        empty_out(encoded, start, stop, target)
    for each in range(-1, len(renderings)):  # the cycle first
        rendered = each >= 0
        if not rendered:
            copy(encoded, channels, width, between)
        else:
            fill(renderings[each], start, stop, width, between)
            clear(of_rendering, channels, width)
            if of_enc:
                terms[0] += _distance(between, encoded, channels, count, width, of_enc, absolute, of_rendering)
                add(of_rendering, channels, width, -ONE, of_all)
        factor = of_dec if rendered else of_cycle
        if factor:
            forward(inner, frequencies, scale, width)
            kind = rendered and absolute
            term = _distance(decoded, given, inputs.shape[1], count, width, factor, kind, of_decoded)
            terms[1 if rendered else 2] += term
            backward(inner, frequencies, scale, width, True)
            add(of_between, channels, width, ONE, of_rendering if rendered else of_all)
        if rendered:
            empty_out(of_rendering, start, stop, of_renderings[each])
    copy(of_all, channels, width, of_encoded)
    backward(outer, frequencies, scale, width, False)


@compiled(f"void({ARGUMENTS}, i8)", fused=True, parallel=False)
def _group(
    rgb, random, random_latent, latents, frequencies, scale, sizes, packed, turned, factors, absolute,
    target, of_latents, terms, sums, group,
):  # fmt: skip
    """One group's share of the tiles: of training colours, of random ones, of random latents."""
    own, colors = count_of(sizes[0]), (rgb, random, random_latent)
    nets = (
        network(packed[:own], turned[:own], sums[group, :own], sizes[0]),
        network(packed[own:], turned[own:], sums[group, own:], sizes[1]),
    )
    for term in range(5):
        terms[group, term] = 0
    for job in range(3):
        inputs = colors[job]
        tiles = (len(inputs) + TILE - 1) // TILE
        for tile in range(tiles * group // len(sums), tiles * (group + 1) // len(sums)):
            _tile(
                nets[job // 2], nets[1 - job // 2], (frequencies, scale), (factors[0], factors[1], factors[2 + job]),
                absolute, inputs, latents if job == 0 else latents[:0], len(inputs) * tile // tiles,
                len(inputs) * (tile + 1) // tiles, target if job == 0 else target[:0], of_latents,
                terms[group, :3] if job == 0 else terms[group, job : job + 3],
            )  # fmt: skip


_share_at = function_at(f"void({ARGUMENTS}, i8)")


@compiled(f"void(i8, {ARGUMENTS})")
def _losses(
    address, rgb, random, random_latent, latents, frequencies, scale, sizes, packed, turned, factors, absolute,
    target, of_latents, terms, sums,
):  # fmt: skip
    """All groups. :func:`_group` is called by its address, so that it is not compiled once more in here."""
    share = _share_at(address)
    for group in prange(len(sums)):
        share(
            rgb, random, random_latent, latents, frequencies, scale, sizes, packed, turned, factors, absolute,
            target, of_latents, terms, sums, np.int64(group),
        )  # fmt: skip
