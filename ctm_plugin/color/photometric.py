"""The photometric loss between two colours, in whatever space they live."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from ctm_plugin.color.settings import LossConfig


class Photometric(LossConfig):
    """``weight * |a - b|^2`` (``mse``) or ``weight * |a - b|`` (``l1``).

    Raises:
        ConfigError: on an unknown kind, or a weight that is negative or infinite.
    """

    def __call__(self, a: Tensor, b: Tensor, reduction: str = "mean") -> Tensor:
        """Distance of ``a`` and ``b`` (``[R, k]``) averaged over rays; over channels ``mean`` or ``sum``."""
        return self.weight * distance(a, b, self.kind, reduction)


def distance(a: Tensor, b: Tensor, kind: str = "mse", reduction: str = "mean") -> Tensor:
    """Squared (``mse``) or absolute (``l1``) differences of ``[R, k]``: mean over rays, mean or sum over channels."""
    between = F.mse_loss if kind == "mse" else F.l1_loss
    return between(a, b) if reduction == "mean" else between(a, b, reduction="sum") / a.shape[0]
