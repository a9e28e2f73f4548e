"""Outlines of patches, drawn on a picture."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw
from torch import Tensor

from ctm_plugin.rays.homography import patch_corners, sl3_exp, to_pixels, warp

OUTLINE_COLORS = ("#e6194b", "#42d4f4", "#f032e6", "#ffe119", "#3cb44b")
"""Colours of the patches' outlines."""


def outlines(
    picture: Float[Tensor, "h w 3"], warps: Float[Tensor, "n 8"], true_warps: Float[Tensor, "n 8"], patch: int
) -> Float[Tensor, "h w 3"]:
    """A picture with the patches' quadrilaterals on it: true ones thin and white, estimated ones in colour."""
    height, width, _ = picture.shape
    canvas = Image.fromarray((picture.clamp(0, 1) * 255).round().byte().numpy())
    pen = ImageDraw.Draw(canvas)
    corners = patch_corners(height, width, patch)
    for of_all, colors, thick in ((true_warps, ["white"] * len(warps), 1), (warps, OUTLINE_COLORS, 3)):
        quads = to_pixels(warp(corners, sl3_exp(of_all)), height, width) - 0.5
        for quad, color in zip(quads.tolist(), colors, strict=True):
            pen.line([tuple(point) for point in [*quad, quad[0]]], fill=color, width=thick, joint="curve")
    return torch.from_numpy(np.array(canvas)).float() / 255
