"""The photometric loss between two colours, in whatever space they live."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from ctm_plugin.data.check import check_choice, check_number

KINDS = ("mse", "l1")


@dataclass(frozen=True, kw_only=True)
class Photometric:
    """``weight * |a - b|^2`` (``mse``) or ``weight * |a - b|`` (``l1``).

    Attributes:
        kind: ``mse`` or ``l1``.
        weight: factor on every photometric term, >= 0.

    Raises:
        ConfigError: on an unknown kind, or a weight that is negative or infinite.
    """

    kind: str = "mse"
    weight: float = 1.0

    def __post_init__(self) -> None:
        check_choice("loss.kind", self.kind, KINDS)
        check_number("loss.weight", self.weight, lambda v: 0 <= v < math.inf, "a number >= 0")

    def __call__(self, a: Tensor, b: Tensor, reduction: str = "mean") -> Tensor:
        """Distance of ``a`` and ``b`` (``[R, k]``) averaged over rays; over channels ``mean`` or ``sum``."""
        error = a - b
        error = error.square() if self.kind == "mse" else error.abs()
        return self.weight * reduce_channels(error, reduction)


def reduce_channels(error: Tensor, reduction: str) -> Tensor:
    """Mean over all entries (``mean``), or mean over rows of the sum over channels (``sum``)."""
    return error.mean() if reduction == "mean" else error.sum() / error.shape[0]
