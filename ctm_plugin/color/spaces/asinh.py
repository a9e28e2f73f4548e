"""An inverse hyperbolic sine of colour, fitted: straight in the dark, a logarithm above."""

from __future__ import annotations

import torch

from ctm_plugin.color.curves import Bent, Number, Values


class Space(Bent):
    bounds = (1e-3, 1e4)

    @staticmethod
    def curve(part: Values, a: Number) -> Values:
        """``h(u) = asinh(a u) / asinh(a)``."""
        return torch.asinh(a * part) / torch.asinh(a)

    @staticmethod
    def inverse(value: Values, a: Number) -> Values:
        return torch.sinh(value * torch.asinh(a)) / a
