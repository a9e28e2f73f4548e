"""Spaces whose channels go each through one increasing curve, fitted to the scene: ``gain``, and what bends it.

Colours of the scene, up to a fitted level, fill [0, 0.9]; the curve goes on as it is for brighter ones, which may lie
beyond 1. A bend there, so that all of [0, 1] fits, would turn a field's small errors near the level into large ones:
it took 1.1 dB from dark lego. Black stays 0. The inverse's slope is about 10 at most: what rounding to float32 takes
from a latent is less than 1e-6 of a colour; what lies between is computed in float64.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.color.srgb import Colors
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.errors import CTMError

Values = Float[Tensor, "*shape"]
Number = Float[Tensor, ""]

TOP_QUANTILE = 0.999
"""Quantile of the colours' largest channels that is the scene's level, which is encoded as ``top``."""
MIN_LEVEL = 1e-3
"""Least level that a scene may have, in sRGB: a quarter of an 8-bit step."""


def nonblack(rgb: Float[Tensor, "n 3"], label: str) -> Float[Tensor, "m 3"]:
    """Colours of a scene that are not black, as float64 on the CPU: a fit is the same on every device.

    Black ones say nothing of the scene: most are the background's. ``label`` says for messages what is fitted.

    Raises:
        CTMError: all are black, or one is NaN or infinite.
    """
    rgb = rgb.detach().double().cpu()
    if not rgb.isfinite().all():
        raise CTMError(f"{label}: found training colours with NaN or infinity, expected numbers in [0, 1]")
    rgb = rgb[rgb.amax(-1) > 0]
    if not len(rgb):
        raise CTMError(f"{label}: found training colours that are all black, expected some light to be fitted to")
    return rgb


def solve(increasing: Callable[[float], float], target: float, low: float, high: float) -> float:
    """Solve ``increasing(x) = target`` for x > 0 within bounds; the nearest bound where there is no solution."""
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if increasing(middle) < target else (low, middle)
    return math.sqrt(low * high)


def as_given(values: Values, given: Float[Tensor, "*given"]) -> Values:
    """Turn float64 results to float32 unless float64 was given: half precision is not enough for colours."""
    return values if given.dtype == torch.float64 else values.float()


class Ranged(ColorTransform):
    """Space with latents ``black + top h(c / level)``, h the identity.

    The level is the 99.9th percentile of the largest channels of the scene's colours, black ones left out, from 0.001
    to ``brightest``. The gain, ``top / level``, is at least 1: bright scenes stay as they are.
    """

    brightest = 0.9
    top: float | Number = 0.9
    """Latent that the level is encoded as, above black's."""
    black: float | Number = 0.0

    def __init__(self, config=None):
        super().__init__(config)
        self.register_buffer("level", torch.tensor(self.brightest))

    def begin(self, rgb: Float[Tensor, "n 3"]) -> None:
        level = torch.quantile(nonblack(rgb, self.label).amax(-1), TOP_QUANTILE)
        self.level.fill_(float(level.clamp(MIN_LEVEL, self.brightest)))

    def describe(self) -> str:
        return f"gain {float(self.top / self.level):.3g}"

    def encode(self, rgb: Colors) -> Colors:
        return as_given(self.black + self.top * self.bend(rgb.double(), self.level.double()), rgb)

    def decode(self, latent: Colors) -> Colors:
        bent = ((latent.double() - self.black) / self.top).clamp_min(0.0)  # some curves have no inverse below black
        return as_given(self.unbend(bent, self.level.double()).clamp_max(1.0), latent)

    def bend(self, color: Values, level: Number) -> Values:
        """Map colours in [0, level] to [0, 1] by the curve h, and brighter ones beyond 1."""
        return color / level

    def unbend(self, value: Values, level: Number) -> Values:
        """Undo :meth:`bend`: map [0, 1] to colours in [0, level]."""
        return value * level


class Bent(Ranged):
    """Space with a curve h(u), u = c / level, ``h(0) = 0``, ``h(1) = 1``, bent so that the scene's median is at 0.5.

    The median is that of all channels of the scene's colours that are not 0. The bend a stays in ``bounds``, which
    begin where it is straight, so that scenes with a bright median are not made darker.
    """

    bounds: tuple[float, float]
    middle = 0.5
    """Latent that the median is encoded as, in (0, 1)."""

    def __init__(self, config=None):
        super().__init__(config)
        self.register_buffer("a", torch.tensor(self.bounds[0]))

    @staticmethod
    def curve(part: Values, a: Number) -> Values:
        """Evaluate the curve h at ``part`` (u) with bend ``a``; it increases in both."""
        raise NotImplementedError

    @staticmethod
    def inverse(value: Values, a: Number) -> Values:
        raise NotImplementedError

    def begin(self, rgb: Float[Tensor, "n 3"]) -> None:
        super().begin(rgb)
        values = nonblack(rgb, self.label)
        median = values[values > 0].median() / self.level.double().cpu()
        self.a.fill_(self.bend_for(median, self.middle, self.bounds))

    def bend_for(self, median: Number, middle: float, bounds: tuple[float, float]) -> float:
        """Find the bend within bounds that brings a median, given as a share of the level, to ``middle``."""
        return solve(lambda a: float(self.curve(median, torch.tensor(a).double())), middle, *bounds)

    def describe(self) -> str:
        return f"{super().describe()}, bent by {round(float(self.a), 3):.3g}"

    def bend(self, color: Values, level: Number) -> Values:
        return self.curve(color / level, self.a.double())

    def unbend(self, value: Values, level: Number) -> Values:
        return self.inverse(value, self.a.double()) * level
