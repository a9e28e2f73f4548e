"""A logarithm of colour, fitted: the scene's median in the middle of its range."""

from __future__ import annotations

import torch
from torch import Tensor

from ctm_plugin.color.curves import Bent


class Space(Bent):
    bounds = (1e-3, 1e4)

    @staticmethod
    def curve(part: Tensor, a: Tensor) -> Tensor:
        """``h(u) = log(1 + a u) / log(1 + a)``."""
        return torch.log1p(a * part) / torch.log1p(a)

    @staticmethod
    def inverse(value: Tensor, a: Tensor) -> Tensor:
        return torch.expm1(value * torch.log1p(a)) / a
