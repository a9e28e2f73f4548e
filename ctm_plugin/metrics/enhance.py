"""PSNR of lifted pictures: what the eye sees when a dark image is brightened (the lifted halves of Figure 4).

Light is linear, so brightening multiplies linear values, never the stored sRGB ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.errors import ConfigError
from ctm_plugin.metrics.image import psnr

WHITE_PERCENTILE = 0.99


def lift(image: Float[Tensor, "*shape"], gain: float) -> Float[Tensor, "*shape"]:
    """Multiply the light of an sRGB image by ``gain``: sRGB -> linear, x gain, clip to [0, 1], -> sRGB.

    Args:
        image: sRGB in [0, 1], any shape.
        gain: factor on linear light, >= 0.

    Returns:
        sRGB in [0, 1], the same shape.
    """
    return linear_to_srgb((srgb_to_linear(image) * gain).clamp(0.0, 1.0))


def enhancement_gain(
    targets: Float[Tensor, "n h w 3"] | Sequence[Float[Tensor, "h w 3"]], exposure: float | None
) -> float:
    """The factor on linear light that brings a test set to a normal exposure.

    ``1 / exposure`` where the exposure is known and not 1; otherwise the factor that brings the 99th percentile of
    the linear values of the whole test set to 1, which is near 1 for a picture that is not dark.

    Args:
        targets: the test images, sRGB ``[N, H, W, 3]`` in [0, 1] or a sequence of ``[H, W, 3]``.
        exposure: light relative to a normal exposure, > 0, or ``None`` where it is not known.

    Returns:
        The gain; 1 for a test set whose 99th percentile is black.

    Raises:
        ConfigError: the exposure is not positive and finite.
    """
    if exposure is not None and not (exposure > 0.0 and math.isfinite(exposure)):
        raise ConfigError("exposure", found=exposure, expected="a number > 0")
    if exposure is not None and exposure != 1.0:
        return 1.0 / exposure
    # sRGB is monotonic, so the percentile may be taken first. torch.quantile refuses more than 2^24 numbers, and
    # kthvalue is refused on a GPU under deterministic algorithms.
    values = torch.cat([target.flatten().cpu() for target in targets])
    white = values.kthvalue(math.ceil(WHITE_PERCENTILE * len(values))).values
    linear = float(srgb_to_linear(white.double()))
    return 1.0 / linear if linear > 0.0 else 1.0


def psnr_enhanced(
    prediction: Float[Tensor, "*batch h w 3"], target: Float[Tensor, "*batch h w 3"], gain: float
) -> Float64[Tensor, "*batch"]:
    """PSNR of each image after :func:`lift` of both by one gain (see :func:`enhancement_gain`).

    Args:
        prediction, target: sRGB ``[..., H, W, 3]`` in [0, 1].
        gain: factor on linear light, the same for the whole test set.

    Returns:
        ``[...]`` decibels.
    """
    return psnr(lift(prediction.double(), gain), lift(target.double(), gain))
