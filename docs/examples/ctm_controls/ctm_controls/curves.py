"""Other curves than the logarithm, fitted as it is: the scene's median in the middle of its range."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ctm_plugin.color.curves import Bent, Number, Values, nonblack
from ctm_plugin.color.spaces.log import Space as Log
from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear

TOE = 1e-3
"""Added under the root, whose slope at black would be infinite."""
SPAN = math.log1p(1 / TOE)


class Asinh(Bent):
    """An inverse hyperbolic sine of colour, fitted: straight in the dark, a logarithm above."""

    bounds = (1e-3, 1e4)

    @staticmethod
    def curve(part: Values, a: Number) -> Values:
        """``h(u) = asinh(a u) / asinh(a)``."""
        return torch.asinh(a * part) / torch.asinh(a)

    @staticmethod
    def inverse(value: Values, a: Number) -> Values:
        return torch.sinh(value * torch.asinh(a)) / a


class Gamma(Bent):
    """A root of colour, fitted: the scene's median in the middle of its range."""

    bounds = (1.0, 100.0)

    @staticmethod
    def curve(part: Values, a: Number) -> Values:
        """``h(u) = ((1 + u / t)^(1/a) - 1) / ((1 + 1/t)^(1/a) - 1)``, t = 0.001: a root of ``u + t``, black at 0."""
        return torch.expm1(torch.log1p(part / TOE) / a) / torch.expm1(SPAN / a)

    @staticmethod
    def inverse(value: Values, a: Number) -> Values:
        return TOE * torch.expm1(a * torch.log1p(value * torch.expm1(SPAN / a)))


class LinearLog(Log):
    """A logarithm of the linear light that colours stand for, fitted."""

    def begin(self, rgb: Tensor) -> None:
        super().begin(rgb)
        values = nonblack(rgb, self.label)
        median = srgb_to_linear(values[values > 0].median()) / srgb_to_linear(self.level.double().cpu())
        self.a.fill_(self.bend_for(median, self.middle, self.bounds))

    def bend(self, color: Values, level: Number) -> Values:
        return self.curve(srgb_to_linear(color) / srgb_to_linear(level), self.a.double())

    def unbend(self, value: Values, level: Number) -> Values:
        return linear_to_srgb(self.inverse(value, self.a.double()) * srgb_to_linear(level))
