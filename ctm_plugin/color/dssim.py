"""Structural dissimilarity, as a loss of whole pictures (3DGS): 1 - SSIM."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.door import looped

WINDOW, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2
"""Constants (0.01 L)² and (0.03 L)² of SSIM (Wang et al. 2004), for colours whose range L is 1."""


@looped("dssim:dssim")
def dssim(image: Float[Tensor, "c h w"], target: Float[Tensor, "c h w"]) -> Float[Tensor, ""]:
    """One minus the mean structural similarity of two pictures under a Gaussian window, sigma 1.5.

    Over windows inside the picture, see :func:`ctm_plugin.metrics.image.ssim`; 0 where no window fits.

    Args:
        image: the picture that gets a gradient, of any number of channels.
        target: the picture to match, without gradient.
    """
    if min(image.shape[1:]) < WINDOW:
        return 0.0 * image.sum()
    line = window(image)
    stack = torch.cat([image, target, image * image, target * target, image * target])[:, None]
    blurred = F.conv2d(F.conv2d(stack, line[None, None, None]), line[None, None, :, None])[:, 0]
    a, b, aa, bb, ab = blurred.chunk(5)
    similar = (2 * a * b + C1) * (2 * (ab - a * b) + C2)
    return 1 - (similar / ((a * a + b * b + C1) * (aa - a * a + bb - b * b + C2))).mean()


def window(like: Tensor) -> Float[Tensor, " 11"]:
    """Weights of SSIM's Gaussian window along a row, ``[11]``, which add up to 1."""
    places = torch.arange(WINDOW, dtype=like.dtype, device=like.device) - WINDOW // 2
    line = (-places.square() / (2 * SIGMA**2)).exp()
    return line / line.sum()
