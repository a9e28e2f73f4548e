"""An inverse hyperbolic sine of colour, fitted: straight in the dark, a logarithm above."""

from __future__ import annotations

import torch
from torch import Tensor

from ctm_plugin.color.curves import Bent


class Space(Bent):
    bounds = (1e-3, 1e4)

    @staticmethod
    def curve(part: Tensor, a: Tensor) -> Tensor:
        """``h(u) = asinh(a u) / asinh(a)``."""
        return torch.asinh(a * part) / torch.asinh(a)

    @staticmethod
    def inverse(value: Tensor, a: Tensor) -> Tensor:
        return torch.sinh(value * torch.asinh(a)) / a
