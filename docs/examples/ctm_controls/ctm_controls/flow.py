"""A colour transform that is learned with the scene and has an exact inverse: no cycle losses, no weights to choose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from ctm_controls.pieces import along, back, times
from ctm_plugin.color.curves import Ranged, as_given
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.srgb import Colors
from ctm_plugin.color.transform import ColorLoss, ColorTransform, Uniform
from ctm_plugin.settings.setting import Settings, setting

FLATTEST = 0.1
"""Smallest slope of a learned curve, so that its inverse's is 10 at most."""
SMALLEST = 1e-3
"""No noise is taken for less, as a part of the latents' range: a quarter of an 8-bit step."""


@dataclass(frozen=True, kw_only=True)
class FlowConfig(Settings, section="ctm"):
    """Size of a :class:`Flow`, and how much its likelihood may weigh."""

    bins: int = setting(16, "straight pieces of each channel's curve", least=1, most=1024)
    heaviest: float = setting(100.0, "largest weight that the field's colours get; the smallest is 1", least=1)


class Flow(ColorTransform):
    """A transform that is learned with the scene, from a gain, and has an exact inverse.

    ``f(C) = s(A g(C))``: a gain fitted to the scene, a matrix, and a curve a channel, the latter two learned.

    - g is :class:`~ctm_plugin.color.curves.Ranged`;
    - ``A = L U``, L unit lower, U upper triangular with a positive diagonal, at first the identity: always invertible,
      ``log |det A|`` is the sum of the diagonal's logarithms (Kingma and Dhariwal, Glow, 2018);
    - s increases in straight pieces from (0, 0) to (1, 1), at first the identity; the outer pieces go on beyond.

    Black stays 0. All is computed in float64. Latents that are no colour decode clipped.
    """

    Config = FlowConfig

    def __init__(self, config: FlowConfig | None = None):
        super().__init__(config)
        self.gain = Ranged()
        self.mix = nn.Parameter(torch.zeros(3, 3))
        self.rises = nn.Parameter(torch.zeros(3, self.config.bins))
        self.log_sigma = nn.Parameter(torch.full((3,), math.log(0.1)))

    def begin(self, rgb: Float[Tensor, "n 3"]) -> None:
        self.gain.label = self.label
        self.gain.begin(rgb)

    def describe(self) -> str:
        return self.gain.describe()

    def encode(self, rgb: Colors) -> Colors:
        return as_given(self._forward(rgb.double())[0], rgb)

    def decode(self, latent: Colors) -> Colors:
        lower, upper = self._triangles()
        eye = torch.eye(3, dtype=torch.float64, device=latent.device)
        inverse = torch.linalg.solve_triangular(lower, eye, upper=False, unitriangular=True)
        inverse = torch.linalg.solve_triangular(upper, inverse, upper=True)
        seen = times(inverse, back(self._knots(), latent.double()))
        return as_given(self.gain.decode(seen).clamp(0.0, 1.0), latent)

    def losses(
        self,
        latents: Sequence[Float[Tensor, "r 3"]],
        rgb: Float[Tensor, "r 3"],
        photometric: Photometric,
        uniform: Uniform,
    ) -> ColorLoss:
        """Means over rays; F the renderings, sigma learned, a channel each.

        - ``color``: ``w |F - f(C)|^2`` for each rendering, to the field alone. ``w = mean of 1 / (2 sigma^2)``, between
          1 and ``heaviest``, which weighs the colours against the field's regularisers;
        - ``nll``: ``sum_i [(F_i - f_i(C))^2 / (2 sigma_i^2) + log sigma_i] - log |det J_f(C)|``, F the last rendering,
          to f and sigma alone: minus the log likelihood of C, but for a constant, where F is f(C) with Gaussian noise.
          The determinant keeps f from shrinking all colours to a point, which has no error either.
        """
        target, log_det = self._forward(rgb.double())
        fixed = target.detach().float()
        log_sigma = self.log_sigma.double().clamp(min=math.log(SMALLEST))
        precision = torch.exp(-2 * log_sigma) / 2
        error = (latents[-1].detach() - target).square()
        nll = ((precision * error + log_sigma).sum(-1) - log_det).mean()
        weight = precision.detach().mean().clamp(1.0, self.config.heaviest).float()
        field = [weight * photometric(latent, fixed) for latent in latents]
        return ColorLoss({"color": torch.stack(field).sum(), "nll": nll.float()}, fixed)

    def _forward(self, rgb: Colors) -> tuple[Colors, Float[Tensor, "*n"]]:
        """``f(C)`` and ``log |det J_f(C)|``, in float64."""
        lower, upper = self._triangles()
        latent, slopes = along(self._knots(), times(lower, times(upper, self.gain.encode(rgb))))
        log_slopes = slopes.log().sum(-1) + 3 * (self.gain.top / self.gain.level.double()).log()
        return latent, log_slopes + self.mix.double().diagonal().sum()

    def _triangles(self) -> tuple[Tensor, Tensor]:
        mix = self.mix.double()
        diagonal = mix.diagonal()
        return torch.tril(mix, -1) + torch.diag(torch.ones_like(diagonal)), torch.triu(mix, 1) + diagonal.exp().diag()

    def _knots(self) -> Float[Tensor, "3 n"]:
        rises = FLATTEST / self.config.bins + (1 - FLATTEST) * self.rises.double().softmax(-1)
        return F.pad(rises.cumsum(-1), (1, 0))
