"""The sRGB curve, between stored colours and light, and pictures multiplied along it for scores.

Light adds up linearly: what brightens multiplies linear values, never the stored ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.errors import ConfigError

Colors = Float[Tensor, "*n 3"]


def srgb_to_linear(srgb: Tensor) -> Tensor:
    """The sRGB curve undone: ``c / 12.92`` up to 0.04045, ``((c + 0.055) / 1.055)^2.4`` above (IEC 61966-2-1).

    Args:
        srgb: ``[...]`` float, in [0, 1].

    Returns:
        ``[...]`` linear light in [0, 1].
    """
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4)


def srgb_slope(srgb: float) -> float:
    """The slope of the sRGB curve, stored over light, at a stored value: 12.92 up to 0.04045, then
    ``1.055 / 2.4 ((c + 0.055) / 1.055)^-1.4``.

    Args:
        srgb: in [0, 1].
    """
    return 12.92 if srgb <= 0.04045 else 1.055 / 2.4 * ((srgb + 0.055) / 1.055) ** -1.4


def linear_to_srgb(linear: Tensor) -> Tensor:
    """The sRGB curve: ``12.92 c`` up to 0.0031308, ``1.055 c^(1/2.4) - 0.055`` above (IEC 61966-2-1).

    Args:
        linear: ``[...]`` float, linear light in [0, 1].

    Returns:
        ``[...]`` in [0, 1].
    """
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


def channels_of(colors: Tensor) -> tuple[Tensor, ...]:
    """The three channels of ``[..., 3]``, in float32 at least: half precision cannot tell dark colours apart."""
    return (colors if colors.dtype == torch.float64 else colors.float()).unbind(-1)


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
    targets: Float[Tensor, "... 3"] | Sequence[Float[Tensor, "... 3"]], exposure: float | None
) -> float:
    """The factor on linear light that brings a test set to a normal exposure.

    ``1 / exposure`` where the exposure is known and not 1; otherwise the factor that brings the 99th percentile of
    the linear values of the whole test set to 1, which is near 1 for a picture that is not dark.

    Args:
        targets: the test images, sRGB ``[N, H, W, 3]`` in [0, 1], or a sequence of images or their pixels ``[P, 3]``.
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
