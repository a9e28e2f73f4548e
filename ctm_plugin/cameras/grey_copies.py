"""Dark photographs as COLMAP should see them: grey, small enough, and as bright as a usual photograph."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float32
from torch import Tensor

from ctm_plugin.color.light import factor_to_mean
from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.data.readers.images import read_image

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Of linear sRGB's primaries (IEC 61966-2-1)."""
THIN = 8
"""One of so many rows and columns says how bright a picture is."""


def read_grey(path: Path, factor: int) -> Float32[Tensor, "h w"]:
    """Read a picture's luminance, averaged as light over ``factor`` x ``factor`` pixels; a rest at the ends is cut.

    Args:
        path: the picture.
        factor: >= 1.

    Returns:
        ``[H // factor, W // factor]`` sRGB in [0, 1].

    Raises:
        DataError: it cannot be read.
    """
    light = srgb_to_linear(read_image(path)[..., :3]) @ torch.tensor(LUMINANCE)
    return linear_to_srgb(F.avg_pool2d(light[None, None], factor)[0, 0].clamp(0, 1))


def find_gain(greys: Sequence[Float32[Tensor, "h w"]]) -> float:
    """Find the factor on light that brings all pictures together to a usual photograph's mean.

    Args:
        greys: ``[h, w]`` each, sRGB in [0, 1].

    Returns:
        >= 1, see :func:`ctm_plugin.color.light.factor_to_mean`.
    """
    levels = torch.cat([grey.flatten() for grey in greys])
    return factor_to_mean(levels, torch.ones_like(levels))
