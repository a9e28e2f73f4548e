"""The scene's own distribution of channels as a curve, fitted: equally many values everywhere."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_controls.pieces import along, back
from ctm_plugin.color.curves import as_given, nonblack, solve
from ctm_plugin.color.srgb import Colors
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.settings.setting import Settings, setting

BINS = 255
"""Pieces of the curve: one between each two 8-bit levels."""
FLATTEST = 0.1
"""Smallest slope, so that the inverse's is 10 at most."""


@dataclass(frozen=True, kw_only=True)
class EqualizeConfig(Settings, section="color_space"):
    """How far a curve may bend."""

    steepest: float = setting(64.0, "largest slope: 64 gives an 8-bit step a quarter of the range", least=2, most=BINS)


class Equalize(ColorTransform):
    """One curve for the channels: the cumulative histogram of the scene's values that are not 0, its slopes bounded.

    Straight between the 8-bit levels, where its slopes are the counts times one factor, but from 0.1 to ``steepest``;
    the factor is such that it ends at (1, 1).
    """

    Config = EqualizeConfig

    def __init__(self, config: EqualizeConfig | None = None):
        super().__init__(config)
        self.register_buffer("knots", torch.linspace(0, 1, BINS + 1))

    def begin(self, rgb: Float[Tensor, "n 3"]) -> None:
        values = nonblack(rgb, self.label)
        levels = (BINS * values[values > 0]).round().clamp(1, BINS).long() - 1
        share = torch.bincount(levels, minlength=BINS).double() / len(levels)
        # A little of every level: with the factor large enough all slopes are then the steepest, so there is one.
        share = share + 1e-6

        def slopes(factor: float) -> Tensor:
            return (factor * share).clamp(FLATTEST, self.config.steepest)

        knots = slopes(solve(lambda factor: float(slopes(factor).mean()), 1.0, 1e-3, 1e9)).cumsum(0)
        self.knots[1:] = knots / knots[-1]

    def describe(self) -> str:
        middle = float(torch.searchsorted(self.knots, torch.tensor(0.5, device=self.knots.device))) / BINS
        return f"half of its range for colours below {middle:.3g}"

    def encode(self, rgb: Colors) -> Colors:
        return as_given(along(self.knots.double().expand(3, -1), rgb.double())[0], rgb)

    def decode(self, latent: Colors) -> Colors:
        return as_given(back(self.knots.double().expand(3, -1), latent.double()).clamp(0.0, 1.0), latent)
