"""The sRGB curve, between stored colours and light. Light adds up linearly: what brightens multiplies light."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

Colors = Float[Tensor, "*n 3"]


def srgb_to_linear(srgb: Tensor) -> Tensor:
    """sRGB ``[...]`` to light (IEC 61966-2-1): ``c / 12.92`` up to 0.04045, ``((c + 0.055) / 1.055)^2.4`` above."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: Tensor) -> Tensor:
    """Light ``[...]`` to sRGB: ``12.92 c`` up to 0.0031308, ``1.055 c^(1/2.4) - 0.055`` above."""
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


def srgb_slope(srgb: float) -> float:
    """Slope of :func:`linear_to_srgb` where it gives ``srgb``, in [0, 1]."""
    return 12.92 if srgb <= 0.04045 else 1.055 / 2.4 * ((srgb + 0.055) / 1.055) ** -1.4


def channels_of(colors: Tensor) -> tuple[Tensor, ...]:
    """The three channels of ``[..., 3]``, in float32 at least: half precision cannot tell dark colours apart."""
    return (colors if colors.dtype == torch.float64 else colors.float()).unbind(-1)
