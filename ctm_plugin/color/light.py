"""More light, or less: pictures multiplied in linear light, and by how much dark ones are.

Scenes shot in the dark are lit ones under less light; dark pictures are brightened for people with a shoulder, so that
lamps keep their shape, and for scores without, so that errors are multiplied as light is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from ctm_plugin.color.settings import MOST_STOPS
from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.errors import ConfigError

MEAN = 0.45
"""Of a lit picture's sRGB values: a little under the middle, where photographs of rooms and things lie."""
KNEE = 0.5
"""Linear light above which the shoulder bends: the last stop below white."""
LEAST = 2.0**0.5
"""Pictures that need less than half a stop are not brightened: they were lit."""
WHITE_PERCENTILE = 0.99
HALVINGS = 60
CHUNK = 1 << 20
"""Pixels counted at once."""


def brighten(
    image: Float[Tensor, "*shape"], factor: float, clip: Literal["shoulder", "hard"] = "shoulder"
) -> Float[Tensor, "*shape"]:
    """An sRGB picture under ``factor`` times the light: sRGB -> linear, x factor, clipped to [0, 1], -> sRGB.

    Monotone in the picture and in the factor; 1 changes nothing but for rounding, less than 1 darkens.

    Args:
        image: sRGB in [0, 1]; as rendered, not as rounded to 8 bits.
        factor: on linear light, > 0.
        clip: ``shoulder``: bent by :func:`shoulder`; ``hard``: cut at 1.

    Returns:
        sRGB in [0, 1], the same shape.
    """
    light = srgb_to_linear(image) * factor
    return linear_to_srgb((shoulder(light, factor) if clip == "shoulder" else light).clamp(0.0, 1.0))


def shoulder(light: Float[Tensor, "*shape"], white: float) -> Float[Tensor, "*shape"]:
    """Bend bright light towards 1, so that lamps keep their shape instead of being clipped.

    Above the knee a = 0.5: ``a + (1 - a) t (1 + t / T^2) / (1 + t)`` with ``t = (x - a) / (1 - a)`` and T the same of
    ``white``, which is Reinhard et al. 2002, "Photographic Tone Reproduction for Digital Images", Eq. 4, moved to the
    knee. Below it the identity. Value and slope are continuous, black stays black, ``white``, the brightest that there
    can be, becomes 1, and the curve rises all the way. For white <= 1 it is the identity.
    """
    above = (light - KNEE).clamp(min=0) / (1 - KNEE)
    top = max(white - KNEE, 1 - KNEE) / (1 - KNEE)
    return light.clamp(max=KNEE) + (1 - KNEE) * above * (1 + above / top**2) / (1 + above)


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
    if exposure is not None and not 0.0 < exposure < math.inf:
        raise ConfigError("exposure", found=exposure, expected="a number > 0")
    if exposure is not None and exposure != 1.0:
        return 1.0 / exposure
    # sRGB is monotonic, so the percentile may be taken first. torch.quantile refuses more than 2^24 numbers, and
    # kthvalue is refused on a GPU under deterministic algorithms.
    values = torch.cat([target.flatten().cpu() for target in targets])
    white = values.kthvalue(math.ceil(WHITE_PERCENTILE * len(values))).values
    linear = float(srgb_to_linear(white.double()))
    return 1.0 / linear if linear > 0.0 else 1.0


def auto_factor(
    colors: UInt8[Tensor, "*shape c"] | Float[Tensor, "*shape c"], mask: Bool[Tensor, "*shape"] | None = None
) -> float:
    """The factor that brings training pictures to the mean :data:`MEAN`; 1 for those that are as bright, or nearly.

    Args:
        colors, mask: see :func:`histogram`.

    Returns:
        1, or at least half a stop (1.41).
    """
    counts = histogram(colors, mask)
    factor = factor_to_mean(torch.arange(len(counts)) / (len(counts) - 1), counts)
    return factor if factor >= LEAST else 1.0


def histogram(
    colors: UInt8[Tensor, "*shape c"] | Float[Tensor, "*shape c"], mask: Bool[Tensor, "*shape"] | None = None
) -> Int64[Tensor, " levels"]:
    """How often each level from 0 to 1 is among the colours: 256 of colours of 8 bits, 65536 of floats in [0, 1].

    Args:
        colors: sRGB, C = 3, or 4 with straight alpha: all channels of all pixels with alpha > 0 count.
        mask: which pixels count; ``None``: all do.
    """
    most = 255 if colors.dtype == torch.uint8 else 65535
    counts = torch.zeros(most + 1, dtype=torch.int64)
    rows = colors.detach().cpu().flatten(0, -2)
    counted = torch.ones(len(rows), dtype=torch.bool) if mask is None else mask.cpu().flatten()
    for part, here in zip(rows.split(CHUNK), counted.split(CHUNK), strict=True):
        codes = part[here & (part[:, 3] > 0) if part.shape[1] == 4 else here, :3]
        codes = codes if most == 255 else (codes * most).round().int()
        counts += torch.bincount(codes.flatten(), minlength=most + 1)
    return counts


def factor_to_mean(levels: Float[Tensor, " n"], counts: Float[Tensor, " n"] | Int64[Tensor, " n"]) -> float:
    """The factor by which brightened colours have the mean :data:`MEAN`, by bisection: it rises with the factor.

    Args:
        levels, counts: sRGB values in [0, 1] and how often each occurs.

    Returns:
        In [1, 1024]: 1 where the mean is reached as it is, and where all is black; 1024 where it is out of reach.
    """
    seen = counts > 0  # few of the levels of floats
    levels, shares = levels[seen].double(), counts[seen].double() / counts.sum().clamp(min=1)
    if not 0.0 < float((levels * shares).sum()) < MEAN:
        return 1.0
    low, high = 0.0, float(MOST_STOPS)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        too_dark = float((brighten(levels, 2.0**middle) * shares).sum()) < MEAN
        low, high = (middle, high) if too_dark else (low, middle)
    return 2.0**high
