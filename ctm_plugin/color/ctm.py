"""The Color Transform Module: a per-pixel encoder and decoder learned with the scene (paper, Sections 3.2 and 3.3)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ctm_plugin.color.photometric import Photometric, distance
from ctm_plugin.color.settings import CTMConfig, LossWeights
from ctm_plugin.color.transform import ColorLoss, ColorTransform, Uniform
from ctm_plugin.rays.encoding import embed


class SinusoidalMLP(nn.Module):
    """Embedding, hidden layers with ReLU, a linear layer, a sigmoid: ``[0,1]^inputs -> [0,1]^outputs``.

    The embedding is ``gamma(c) = [c, sin(2^p s c), cos(2^p s c)]``, p = 0..P-1, of ``inputs (1 + 2 P)`` numbers
    (Eq. 7), with s = pi or 1. Always float32, also inside an autocast region.
    """

    def __init__(self, inputs: int, outputs: int, config: CTMConfig):
        super().__init__()
        self.scale = math.pi if config.frequency == "pi" else 1.0
        self.register_buffer("frequencies", self.scale * 2.0 ** torch.arange(config.P), persistent=False)
        self.sizes = [inputs * (1 + 2 * config.P), *[config.width] * config.depth, outputs]
        self.linear = [nn.Linear(a, b) for a, b in pairwise(self.sizes)]
        hidden = [layer for linear in self.linear[:-1] for layer in (linear, nn.ReLU(inplace=True))]
        self.layers = nn.Sequential(*hidden, self.linear[-1], nn.Sigmoid())

    def forward(self, color: Float[Tensor, "*n c"]) -> Float[Tensor, "*n d"]:
        with torch.autocast(color.device.type, enabled=False):
            return self.layers(embed(color.float(), self.frequencies))

    @torch.no_grad()
    def approach(self, matrix: Float[Tensor, "d c"], bias: Float[Tensor, " d"], rest: float = 0.1) -> None:
        """Start near ``sigmoid(matrix c + bias)``: the first hidden units pass the colour on (which is >= 0, so that
        ReLU keeps it), and what the other units add is scaled by ``rest``.
        """
        count = matrix.shape[1]
        *hidden, last = self.linear
        for layer in hidden:
            layer.weight[:count] = torch.eye(count, layer.weight.shape[1])
            layer.bias[:count] = 0
        last.weight.mul_(rest)
        last.weight[:, :count] = matrix
        last.bias.copy_(bias)


class Given(NamedTuple):
    """Colours and latents that the CTM's losses of a step are computed from."""

    latents: list[Tensor]
    """Rendered latents, ``[R, k]`` each."""
    rgb: Tensor
    """Training colours of the same rays, ``[R, 3]``."""
    random: Tensor
    """Random colours ``[S, 3]`` from U[0, 1], none where the term ``rand`` has weight 0."""
    random_latent: Tensor
    """Random latents ``[T, k]`` from U[0, 1], none where the term ``latent`` has weight 0."""


def five_terms(
    encoder: SinusoidalMLP, decoder: SinusoidalMLP, given: Given, photometric: Photometric, weights: LossWeights,
    reduction: str,
) -> tuple[dict[str, Tensor], Tensor]:  # fmt: skip
    """Compute the terms of :meth:`CTM.losses` by name, those of weight above 0, and the encoded training colours."""
    latents, rgb, random, random_latent = given
    # All colours go through each network in one batch: small layers cost their launches, not their arithmetic.
    target, encoded_random = encoder(torch.cat([rgb, random])).split([len(rgb), len(random)])
    rendered = latents if weights.dec else []
    cycled = target if weights.img else target[:0]
    decoded = decoder(torch.cat([*rendered, cycled, encoded_random, random_latent]))
    sizes = [len(rgb) * len(rendered), len(cycled), len(random), len(random_latent)]
    rendered_rgb, cycled_rgb, cycled_random, decoded_latent = decoded.split(sizes)

    terms = {}
    if latents and weights.enc:
        terms["enc"] = weights.enc * sum(photometric(latent, target, reduction) for latent in latents)
    if rendered:
        parts = rendered_rgb.chunk(len(rendered))
        terms["dec"] = weights.dec * sum(photometric(part, rgb, reduction) for part in parts)
    if weights.img:
        terms["img"] = weights.img * distance(cycled_rgb, rgb, reduction=reduction)
    if weights.rand:
        terms["rand"] = weights.rand * distance(cycled_random, random, reduction=reduction)
    if weights.latent:
        terms["latent"] = weights.latent * distance(encoder(decoded_latent), random_latent, reduction=reduction)
    return terms, target.detach()


class CTM(ColorTransform):
    """Color Transform Module: encoder ``f: [0,1]^3 -> [0,1]^k`` and decoder ``g: [0,1]^k -> [0,1]^3``.

    Example:
        >>> ctm = CTM()
        >>> ctm.decode(ctm.encode(torch.rand(5, 3))).shape
        torch.Size([5, 3])
    """

    Config = CTMConfig

    def __init__(self, config: CTMConfig | None = None):
        super().__init__(config)
        self.channels = self.config.k
        self.encoder = SinusoidalMLP(3, self.channels, self.config)
        self.decoder = SinusoidalMLP(self.channels, 3, self.config)

    def begin(self, rgb: Float[Tensor, "n 3"]) -> None:
        """With ``init=range``: start from the range [low, high] of the scene's colours (1st and 99th percentile).

        ``f(c) = sigmoid(4 (c - middle) / span)``, span being the widest channel's, at least 1/64: the scene's colours
        fill the cube, and between them f is close to affine.
        g starts as a sigmoid of an affine map too, with the value and the slope of f's inverse in the middle of the
        range. With k other than 3, colour channel j and latent channel i belong together where i = j modulo min(k, 3).
        """
        if self.config.init != "range":
            return
        low, high = torch.quantile(rgb.float(), torch.tensor([0.01, 0.99], device=rgb.device), dim=0)
        gain = 4 / (high - low).max().clamp_min(1 / 64)
        middle = ((low + high) / 2).clamp(0.02, 0.98)
        groups = min(self.channels, 3)
        pairs = torch.arange(self.channels)[:, None].remainder(groups) == torch.arange(3).remainder(groups)
        pairs = pairs.to(rgb)
        matrix = pairs / pairs.sum(1, keepdim=True)
        self.encoder.approach(gain * matrix, -gain * matrix @ middle)
        # Slope 4 of the logit of a latent, 1 / gain of a colour: d logit(c) / d l = 4 / (gain c (1 - c)).
        slope = (4 / (gain * middle * (1 - middle))).clamp_max(16.0)
        matrix = (pairs / pairs.sum(0)).T
        self.decoder.approach(slope[:, None] * matrix, torch.logit(middle) - slope / 2)

    def encode(self, rgb: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n k"]:
        return self.encoder(rgb)

    def decode(self, latent: Float[Tensor, "*n k"]) -> Float[Tensor, "*n 3"]:
        return self.decoder(latent)

    def losses(
        self,
        latents: Sequence[Float[Tensor, "r k"]],
        rgb: Float[Tensor, "r 3"],
        photometric: Photometric,
        uniform: Uniform,
    ) -> ColorLoss:
        """The five weighted terms; means over rays (or random colours), summed (or averaged) over channels.

        - ``enc``: ``|| F(r) - f(C) ||^2`` (Eq. 4), for each rendering F; gradients reach the field and the encoder;
        - ``dec``: ``|| g(F(r)) - C ||^2`` (Eq. 5), for each rendering;
        - ``img``: ``|| C - g(f(C)) ||^2`` on the batch's colours, ``rand``: on uniform colours (Eq. 8);
        - ``latent``: ``|| l - f(g(l)) ||^2`` on uniform latents (Eq. 9).

        With an L1 photometric loss ``enc`` and ``dec`` are absolute differences; the cycles stay squared.
        Terms of weight 0 are not computed. Without ``latents`` only the cycles are given (pre-training).
        """
        weights, rays = self.config.weights, rgb.shape[0]
        count = self.config.random_colors or rays
        latents = [latent.float() for latent in latents]
        random = uniform(count, 3) if weights.rand else rgb[:0]
        random_latent = uniform(count, self.channels) if weights.latent else rgb.new_empty(0, self.channels)
        given = Given(latents, rgb, random, random_latent)
        return ColorLoss(*five_terms(self.encoder, self.decoder, given, photometric, weights, self.config.reduction))

    def cycle_loss(self, rgb: Float[Tensor, "r 3"], uniform: Uniform) -> Tensor:
        """Sum of the weighted cycle terms, ``[]``: the objective of pre-training, without a field."""
        return sum(self.losses([], rgb, Photometric(), uniform).terms.values(), rgb.new_zeros(()))
