"""A logarithm of colour, fitted: the scene's median in the middle of its range."""

from __future__ import annotations

import torch

from ctm_plugin.color.curves import Bent, Number, Values


class Space(Bent):
    bounds = (1e-3, 1e4)

    @staticmethod
    def curve(part: Values, a: Number) -> Values:
        """Evaluate the curve ``h(u) = log(1 + a u) / log(1 + a)``, u = ``part``."""
        return torch.log1p(a * part) / torch.log1p(a)

    @staticmethod
    def inverse(value: Values, a: Number) -> Values:
        return torch.expm1(value * torch.log1p(a)) / a
