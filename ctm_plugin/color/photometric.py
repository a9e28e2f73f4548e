"""The photometric loss between two colours, in whatever space they live."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch.nn.functional as F
from torch import Tensor

from ctm_plugin.settings.build import setting
from ctm_plugin.settings.check import check_choice, check_number

KINDS = ("mse", "l1")


@dataclass(frozen=True, kw_only=True)
class Photometric:
    """``weight * |a - b|^2`` (``mse``) or ``weight * |a - b|`` (``l1``).

    Raises:
        ConfigError: on an unknown kind, or a weight that is negative or infinite.
    """

    kind: str = setting(
        "mse",
        "mse: squared differences; l1: absolute differences",
        composed="${oc.select:backbone.photometric,${oc.select:ctm.photometric,mse}}",
    )
    weight: float = setting(1.0, "factor on every photometric term")

    def __post_init__(self) -> None:
        check_choice("loss.kind", self.kind, KINDS)
        check_number("loss.weight", self.weight, lambda v: 0 <= v < math.inf, "a number >= 0")

    def __call__(self, a: Tensor, b: Tensor, reduction: str = "mean") -> Tensor:
        """Distance of ``a`` and ``b`` (``[R, k]``) averaged over rays; over channels ``mean`` or ``sum``."""
        return self.weight * distance(a, b, self.kind, reduction)


def distance(a: Tensor, b: Tensor, kind: str = "mse", reduction: str = "mean") -> Tensor:
    """Squared (``mse``) or absolute (``l1``) differences of ``[R, k]``: mean over rays, mean or sum over channels."""
    between = F.mse_loss if kind == "mse" else F.l1_loss
    return between(a, b) if reduction == "mean" else between(a, b, reduction="sum") / a.shape[0]
