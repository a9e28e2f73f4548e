"""How well patches are aligned (paper, Table 3)."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from ctm_plugin.rays.homography import patch_corners, sl3_exp, to_pixels, warp


def warp_errors(warps: Float[Tensor, "n 8"], true_warps: Float[Tensor, "n 8"]) -> Float[Tensor, " n"]:
    """``|| h - h_true ||`` of each patch, in sl(3); the mean over patches is the paper's warping error."""
    return (warps - true_warps).norm(dim=-1)


def corner_errors(
    warps: Float[Tensor, "n 8"], true_warps: Float[Tensor, "n 8"], height: int, width: int, patch: int
) -> Float[Tensor, " n"]:
    """Mean distance of each patch's four corners from where they belong, in pixels of the picture.

    Args:
        warps, true_warps: parameters of the homographies.
        height, width, patch: sizes of the picture and of the patches, in pixels.
    """
    corners = patch_corners(height, width, patch).to(warps)
    at, belongs = (to_pixels(warp(corners, sl3_exp(h)), height, width) for h in (warps, true_warps))
    return (at - belongs).norm(dim=-1).mean(-1)
