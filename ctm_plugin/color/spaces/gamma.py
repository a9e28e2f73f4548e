"""A root of colour, fitted: the scene's median in the middle of its range."""

from __future__ import annotations

import math

import torch

from ctm_plugin.color.curves import Bent, Number, Values

TOE = 1e-3
"""Added under the root, whose slope at black would be infinite."""
SPAN = math.log1p(1 / TOE)


class Space(Bent):
    bounds = (1.0, 100.0)

    @staticmethod
    def curve(part: Values, a: Number) -> Values:
        """``h(u) = ((1 + u / t)^(1/a) - 1) / ((1 + 1/t)^(1/a) - 1)``, t = 0.001: a root of ``u + t``, black at 0."""
        return torch.expm1(torch.log1p(part / TOE) / a) / torch.expm1(SPAN / a)

    @staticmethod
    def inverse(value: Values, a: Number) -> Values:
        return TOE * torch.expm1(a * torch.log1p(value * torch.expm1(SPAN / a)))
