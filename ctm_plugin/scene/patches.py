"""Patches of a picture, to be aligned: what BARF-2D is trained on."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


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
