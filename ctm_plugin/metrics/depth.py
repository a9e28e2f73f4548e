"""Errors of the expected depth against true depth, in scene units. Where the true depth is NaN there is no surface."""

from __future__ import annotations

import torch
from jaxtyping import Float, Float64
from torch import Tensor


def surface_errors(depth: Float[Tensor, "*shape"], true_depth: Float[Tensor, "*shape"]) -> Float64[Tensor, " pixels"]:
    """``|depth - true_depth|`` of every pixel that shows a surface.

    Args:
        depth: expected distance along the ray, any shape, scene units.
        true_depth: the same for the true surface; pixels where it is not finite are left out.

    Returns:
        ``[pixels]`` errors in scene units, empty where no pixel counts.
    """
    counted = torch.isfinite(true_depth)
    return (depth[counted].double() - true_depth[counted].double()).abs()


def mean_absolute_error(errors: Float64[Tensor, " pixels"]) -> float | None:
    """Mean of :func:`surface_errors`, scene units; ``None`` without pixels."""
    return float(errors.mean()) if len(errors) else None
