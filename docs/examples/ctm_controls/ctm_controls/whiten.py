"""Colours without most of their correlation, fitted: chroma varies nearly as much as luminance."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_controls.pieces import times
from ctm_plugin.color.curves import as_given, nonblack
from ctm_plugin.color.srgb import Colors
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.settings.setting import Settings, setting

ROOM = 0.05
"""Of the cube, on each side of the scene's range."""
LEAST = 1e-6
"""No variance is taken for less."""
NARROWEST = 0.1
"""No channel's range is taken for less of the widest one's: one without variation is not blown up."""


@dataclass(frozen=True, kw_only=True)
class WhitenConfig(Settings, section="color_space"):
    """How much of the correlation goes."""

    shrink: float = setting(
        0.1, "part of the largest variance added to all: 0.01 nearly whitens, 1 hardly does", least=0.01, most=1
    )


class Whiten(ColorTransform):
    """``z = A c + b``: ``A = D (S + s max(S) I)^(-1/2)``, S the covariance of the scene's colours (ZCA, shrunk).

    D and b bring each channel's 0.05th to 99.95th percentile, and black, into [0.05, 0.95]; ``max(S)`` is the largest
    eigenvalue. b is black, which decodes to exactly 0. Colours beyond the scene's may lie outside [0, 1], where a field
    whose latents end in a sigmoid cannot follow; they come back all the same. Latents that are no colour are clipped.
    """

    Config = WhitenConfig

    def __init__(self, config: WhitenConfig | None = None):
        super().__init__(config)
        self.register_buffer("matrix", torch.eye(3))
        self.register_buffer("inverse", torch.eye(3, dtype=torch.float64))
        self.register_buffer("black", torch.zeros(3))

    def begin(self, rgb: Float[Tensor, "n 3"]) -> None:
        rgb = nonblack(rgb, self.label)
        values, vectors = torch.linalg.eigh(torch.cov(rgb.T, correction=0))
        values = (values + self.config.shrink * values[-1]).clamp(min=LEAST)
        whitening = (vectors / values.sqrt()) @ vectors.T
        seen = rgb @ whitening.T
        low, high = torch.quantile(seen, torch.tensor([0.0005, 0.9995]).double(), dim=0)
        low, high = low.clamp(max=0), high.clamp(min=0)
        span = high - low
        scale = (1 - 2 * ROOM) / span.clamp(min=NARROWEST * float(span.max()))
        self.matrix.copy_(scale[:, None] * whitening)
        self.inverse.copy_(torch.linalg.inv(self.matrix.double().cpu()))
        self.black.copy_(ROOM - scale * low)

    def describe(self) -> str:
        spread = torch.linalg.svdvals(self.matrix.cpu())
        return f"gain {float(spread[-1]):.3g} along the colours' largest variance, {float(spread[0]):.3g} across"

    def encode(self, rgb: Colors) -> Colors:
        return as_given(times(self.matrix.double(), rgb.double()) + self.black, rgb)

    def decode(self, latent: Colors) -> Colors:
        return as_given(times(self.inverse, latent.double() - self.black).clamp(0.0, 1.0), latent)
