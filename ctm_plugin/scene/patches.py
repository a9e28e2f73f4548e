"""Patches of a picture, to be aligned: what BARF-2D is trained on."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from ctm_plugin.rays.homography import patch_corners, pixel_grid, sl3_exp, warp


@dataclass(frozen=True)
class PlanarScene:
    """One picture, and patches of it under homographies.

    Attributes:
        name: in tables: the picture's name.
        image: ``[H, W, 3]`` sRGB in [0, 1], dimmed, of 8 bits.
        true_warps: ``[5, 8]`` parameters of the homographies, see :func:`ctm_plugin.rays.homography.sl3_exp`; they take
            the patch in the middle of the picture to where its colours come from. The first is 0.
        patches: ``[5, P, P, 3]`` as trained on, with noise where there is any.
        clean: ``[5, P, P, 3]`` without noise, for metrics.
        exposure: light relative to the photograph's.
    """

    name: str
    image: Float[Tensor, "h w 3"]
    true_warps: Float[Tensor, "n 8"]
    patches: Float[Tensor, "n p p 3"]
    clean: Float[Tensor, "n p p 3"]
    exposure: float

    @property
    def height(self) -> int:
        return self.image.shape[0]

    @property
    def width(self) -> int:
        return self.image.shape[1]

    @property
    def patch(self) -> int:
        return self.patches.shape[1]

    def seen(self) -> Bool[Tensor, "h w"]:
        """Pixels of the picture that at least one patch shows."""
        corners = patch_corners(self.height, self.width, self.patch)
        (left, top), (right, bottom) = corners[0], corners[2]
        back = warp(pixel_grid(self.height, self.width).flatten(0, 1), sl3_exp(-self.true_warps))
        inside = (back[..., 0] >= left) & (back[..., 0] <= right) & (back[..., 1] >= top) & (back[..., 1] <= bottom)
        return inside.any(0).view(self.height, self.width)
