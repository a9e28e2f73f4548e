"""Errors of the expected depth against true depth, in scene units. Where the true depth is NaN there is no surface."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor


def surface_errors(
    depth: Float[Tensor, "*shape"],
    true_depth: Float[Tensor, "*shape"],
    mask: Bool[Tensor, "*shape"] | None = None,
) -> Float64[Tensor, " pixels"]:
    """``|depth - true_depth|`` of every pixel that shows a surface.

    Args:
        depth: expected distance along the ray, any shape, scene units.
        true_depth: the same for the true surface; pixels where it is not finite are left out.
        mask: pixels to count, all by default.

    Returns:
        ``[pixels]`` errors in scene units, empty where no pixel counts.
    """
    counted = torch.isfinite(true_depth)
    if mask is not None:
        counted = counted & mask
    return (depth[counted].double() - true_depth[counted].double()).abs()


def mean_absolute_error(errors: Float64[Tensor, " pixels"]) -> float | None:
    """Mean of :func:`surface_errors`, scene units; ``None`` without pixels."""
    return float(errors.mean()) if len(errors) else None


def median_error(errors: Float64[Tensor, " pixels"]) -> float | None:
    """Median of :func:`surface_errors` (mean of the middle two), scene units; ``None`` without pixels."""
    return float(np.median(errors.cpu().numpy())) if len(errors) else None
