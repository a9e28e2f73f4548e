"""Dark photographs as COLMAP should see them: grey, small enough, and as bright as a usual photograph."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float32
from torch import Tensor

from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.data.readers.images import read_image

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Of linear sRGB's primaries (IEC 61966-2-1)."""
MID_GREY = 0.45
"""Mean of a usual photograph, sRGB."""
MOST = 20.0
"""Stops by which light may be turned up."""
THIN = 8
"""One of so many rows and columns says how bright a picture is."""


def read_light(path: Path, factor: int) -> Float32[Tensor, "h w"]:
    """A picture's linear luminance, averaged over ``factor`` x ``factor`` pixels; what is left at the ends is cut.

    Args:
        path: the picture.
        factor: >= 1.

    Raises:
        DataError: it cannot be read.
    """
    light = srgb_to_linear(read_image(path)[..., :3]) @ torch.tensor(LUMINANCE)
    return light if factor == 1 else F.avg_pool2d(light[None, None], factor)[0, 0]


def find_gain(lights: Sequence[Float32[Tensor, "h w"]]) -> float:
    """The factor on linear light, >= 1, that brings the mean of all pictures, in sRGB, to mid-grey.

    Args:
        lights: linear luminance in [0, 1].

    Returns:
        The factor, found by halving; 1 where pictures are bright enough, 2^20 at most.
    """
    light = torch.cat([each.flatten() for each in lights])
    low, high = 0.0, MOST
    for _ in range(20):
        middle = (low + high) / 2
        bright = float(brighten(light, 2**middle).mean()) >= MID_GREY
        low, high = (low, middle) if bright else (middle, high)
    return 2**high if float(brighten(light, 1.0).mean()) < MID_GREY else 1.0


def brighten(light: Float32[Tensor, "*shape"], gain: float) -> Float32[Tensor, "*shape"]:
    """Linear light times ``gain``, clipped to what a picture can show, in sRGB."""
    return linear_to_srgb((light * gain).clamp(max=1.0))
