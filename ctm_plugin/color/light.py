"""The light that dark pictures are shown in: found like a camera finds it, and one curve for a whole scene.

Scenes shot in the dark are lit ones under less light. For people they are brightened by a :class:`Light`, so that lamps
keep their shape; for scores only by a factor (:func:`brighten`), so that errors are multiplied as light is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int64, UInt8
from torch import Tensor

from ctm_plugin.color.settings import MAX_STOPS, LightConfig, stops_of
from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.errors import ConfigError


class Aim(NamedTuple):
    """Target of a statistic of lit pictures, and the deviation from it that costs one unit."""

    at: float
    within: float


TARGET_MEAN, TARGET_TOP, TARGET_DEVIATION, TARGET_CONTRAST = (
    Aim(0.45, 0.05),
    Aim(0.8, 0.025),
    Aim(0.2, 0.05),
    Aim(0.0, 0.2),
)
"""Targets of a lit scene's sRGB, as in well-exposed photographs: mean, mean of the brightest tenth, standard deviation;
and the logarithm of the contrast."""
TARGET_SATURATION, MAX_SATURATION = 0.45, 1.25
"""Mean saturation that colours are brought up to, and the largest factor for it: noise is coloured as well."""
ROOM_STOPS, ROOM_SPREADS = 3.0, 2.5
"""Distance above the median, in stops and in multiples of the darkest sixth's distance below it, where windows and
lamps begin."""
MIN_BRIGHTNESS = 0.05
"""Least brightness of an averaging square whose saturation counts, as a share of the squares' mean."""
STOPS, CONTRASTS = torch.arange(0, MAX_STOPS + 0.01, 0.04).double(), 1 + 0.02 * torch.arange(33).double()
"""Stops and contrasts that the search for a scene's light tries."""
QUANTILES = 512
"""Number of quantiles that stand for all linear values of a scene."""
SQUARES_ACROSS = 94
"""Number of averaging squares along a picture's shorter side; they average noise out."""
HISTOGRAM_BINS = 65536
"""Number of bins in the histogram of averaged colours."""
LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Weights of red, green and blue in the luminance of linear sRGB (IEC 61966-2-1)."""
PALE = 3e-5
"""Linear light whose colours are halved, a tenth of the first grey level of 8 bits: photographs have noise there."""
KNEE = 0.5
"""Linear light above which the shoulder bends: one stop below white."""
MIN_GAIN = 2.0**0.5
"""Least gain that is applied, half a stop: pictures that need less were lit."""
WHITE_QUANTILE = 0.99
"""Quantile of a test set's values that the enhancement gain brings to white."""
BISECTIONS = 60
"""Number of steps of a bisection, down to float64's rounding."""


@dataclass(frozen=True)
class Light:
    """Gain, contrast and saturation with which pictures of a scene are displayed; by default as they are.

    Linear light x of a pixel, with luminance l = 0.2126 r + 0.7152 g + 0.0722 b, becomes sRGB y by::

        x' = max(0, l + saturation l / (l + 3e-5) (x - l))
        t  = srgb(shoulder(gain x', gain))
        y  = t^contrast / (t^contrast + (1 - t)^contrast)

    Greys stay grey, black and white stay, and on greys it rises all the way. Next to black colours fade, as photographs
    have nothing but noise there.

    Attributes:
        gain: factor on linear light, > 0.
        contrast: about a middle grey, > 0; above 1 blacks are deeper.
        saturation: distance of colours from grey, >= 0.
    """

    gain: float = 1.0
    contrast: float = 1.0
    saturation: float = 1.0

    def apply(self, rgb: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape 3"]:
        """Light up sRGB in [0, 1], as rendered and not as rounded to 8 bits; it stays in [0, 1]."""
        if self == AS_IS:
            return rgb
        light = saturated(srgb_to_linear(rgb), self.saturation) * self.gain
        return contrasted(linear_to_srgb(shoulder(light, self.gain).clamp(0.0, 1.0)), self.contrast)


AS_IS = Light()
"""The light that leaves pictures as they are."""


def chosen_light(settings: LightConfig, auto: Light) -> Light:
    """Resolve settings to a light; ``auto`` is the light that was found for the scene."""
    stops = stops_of(settings.light)
    base = auto if stops is None else Light(2.0**stops)
    return Light(
        base.gain,
        base.contrast if settings.contrast is None else settings.contrast,
        base.saturation if settings.saturation is None else settings.saturation,
    )


def saturated(light: Float[Tensor, "*shape 3"], saturation: float) -> Float[Tensor, "*shape 3"]:
    """Multiply linear light's distance from grey l by ``saturation l / (l + PALE)``; negative light is cut to 0."""
    grey = (light @ light.new_tensor(LUMINANCE))[..., None]
    return (grey + saturation * grey / (grey + PALE) * (light - grey)).clamp(min=0.0)


def contrasted(srgb: Float[Tensor, "*shape"], contrast: float) -> Float[Tensor, "*shape"]:
    """Apply contrast k to sRGB t in [0, 1]: ``t^k / (t^k + (1 - t)^k)``."""
    if contrast == 1:
        return srgb
    bright = srgb**contrast
    return bright / (bright + (1 - srgb) ** contrast)


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
    white = values.kthvalue(math.ceil(WHITE_QUANTILE * len(values))).values
    linear = float(srgb_to_linear(white.double()))
    return 1.0 / linear if linear > 0.0 else 1.0


def find_light(
    colors: UInt8[Tensor, "*shape c"] | Float[Tensor, "*shape c"], mask: Bool[Tensor, "*shape"] | None = None
) -> Light:
    """Find the light to display dark pictures in, from their colours; no change for those that are lit, or nearly.

    Saturation S is the mean of 1 - least / largest channel; ``saturation = 0.45 / S``, in [1, 1.25]. Gain g and
    contrast k minimise, over what the pictures become::

        ((mean - 0.45) / 0.05)^2 + ((top - 0.8) / 0.025)^2 + ((deviation - 0.2) / 0.05)^2 + (ln k / 0.2)^2,  k >= 1

    ``top`` is the mean of the brightest tenth. All are of the :func:`squares` of the :func:`room`, and of all three
    channels together. Neither the pictures' order nor the device they are on makes a difference.

    Args:
        colors, mask: see :func:`squares`.

    Returns:
        A light that changes nothing, or brightens by at least half a stop (1.41).
    """
    light, counts, *_ = squares(colors, mask)
    kept = room(light, counts)
    light, counts = light[kept], counts[kept]
    bright = light.amax(1)
    seen = bright > MIN_BRIGHTNESS * float((bright * counts).sum() / counts.sum().clamp(min=1))
    if not seen.any():
        return AS_IS
    distance = (1 - light[seen].amin(1) / bright[seen]).double() @ counts[seen] / counts[seen].sum()
    saturation = round(min(max(TARGET_SATURATION / max(float(distance), 1e-3), 1.0), MAX_SATURATION), 2)
    values = shares(saturated(light, saturation), counts)
    gains = 2.0**STOPS
    shown = torch.stack([linear_to_srgb(shoulder(values * gain, gain).clamp(0, 1)) for gain in gains.tolist()])
    logits = shown.clamp(1e-12, 1 - 1e-12).logit()  # contrast multiplies these
    best, gain, contrast = math.inf, 1.0, 1.0
    for power in CONTRASTS.tolist():
        lit = (power * logits).sigmoid()
        top = lit[:, -(QUANTILES // 10) :].mean(1)
        numbers = ((lit.mean(1), TARGET_MEAN), (top, TARGET_TOP), (lit.std(1, correction=0), TARGET_DEVIATION))
        cost = sum(((number - aim.at) / aim.within) ** 2 for number, aim in numbers)
        cost += ((math.log(power) - TARGET_CONTRAST.at) / TARGET_CONTRAST.within) ** 2
        if (least := float(cost.min())) < best:
            best, gain, contrast = least, float(gains[cost.argmin()]), round(power, 2)
    return Light(gain, contrast, saturation) if gain >= MIN_GAIN else AS_IS


def room(light: Float[Tensor, "s 3"], counts: Float64[Tensor, " s"]) -> Bool[Tensor, " s"]:
    """Tell squares of linear light from windows and lamps: these may become white, as in a photograph of the room.

    The room's squares have at most luminance ``m 2^max(3, 2.5 log2(m / d))``: m is the median and d the 16th percentile
    of squares with light, weighted by ``counts``. The second number keeps what is bright in scenes of many stops.
    """
    luminance = light @ light.new_tensor(LUMINANCE)
    lit = luminance > 0
    if not lit.any():
        return ~lit
    values, order = luminance[lit].double().sort()
    below = counts[lit][order].cumsum(0)
    dark, median = values[torch.searchsorted(below, below.new_tensor([0.16, 0.5]) * below[-1])].log2().tolist()
    return luminance <= 2 ** (median + max(ROOM_STOPS, ROOM_SPREADS * (median - dark)))


class Squares(NamedTuple):
    """Squares of pictures ``[N, H, W, C]``, and the light that they have on average."""

    light: Float[Tensor, "s 3"]
    """Mean linear light of the pixels that count."""
    counts: Float64[Tensor, " s"]
    """Number of pixels that count."""
    view: Int64[Tensor, " s"]
    """Index of the picture."""
    at: Float[Tensor, "s 2"]
    """Middle of the square in the picture: x to the right and y down, each from 0 to 1."""


def squares(
    colors: UInt8[Tensor, "*shape c"] | Float[Tensor, "*shape c"], mask: Bool[Tensor, "*shape"] | None = None
) -> Squares:
    """Average linear light over squares of pictures ``[N, H, W, C]``; colours of other shapes are not averaged.

    Args:
        colors: sRGB, C = 3, or 4 with straight alpha: pixels with alpha > 0 count. Bytes, or floats in [0, 1].
        mask: which pixels count; ``None``: all do.

    Returns:
        The squares with pixels that count. Rows and columns that fill no square are left out.
    """
    table = srgb_to_linear(torch.arange(256) / 255)
    batched = colors.ndim == 4
    pictures, masks = (colors, mask) if batched else (colors.reshape(1, 1, -1, colors.shape[-1]), mask)
    side = max(1, round(min(pictures.shape[1:3]) / SQUARES_ACROSS)) if batched else 1
    height, width = pictures.shape[1:3]
    row, column = torch.meshgrid(torch.arange(height // side), torch.arange(width // side), indexing="ij")
    middles = torch.stack([(column + 0.5) * side / width, (row + 0.5) * side / height], -1)
    means, counts, views, places = [], [], [], []
    for index, picture in enumerate(pictures):
        code = picture[..., :3].detach().cpu()
        if code.dtype == torch.uint8:
            light = table.index_select(0, code.flatten().int()).view(code.shape)
        else:
            light = srgb_to_linear(code.float())
        counted = None if masks is None else (masks[index] if batched else masks.reshape(1, -1)).cpu()
        if picture.shape[-1] == 4:
            there = picture[..., 3].detach().cpu() > 0
            counted = there if counted is None else there & counted
        if counted is None:
            number = torch.full(middles.shape[:2], float(side**2), dtype=torch.float64)
        else:
            light, number = light * counted[..., None], tiled(counted[..., None].double(), side)[..., 0]
        kept = number > 0
        means.append(tiled(light, side)[kept] / number[kept, None].float())
        counts.append(number[kept])
        views.append(torch.full((len(counts[-1]),), index))
        places.append(middles[kept])
    return Squares(*map(torch.cat, (means, counts, views, places)))


def tiled(values: Float[Tensor, "h w c"], side: int) -> Float[Tensor, "rows columns c"]:
    """Sum values over squares of ``side`` x ``side`` pixels."""
    height, width, channels = values.shape[0] // side, values.shape[1] // side, values.shape[2]
    whole = values[: height * side, : width * side]
    rows = whole.reshape(height, side, width * side, channels).sum(1)
    return rows.view(height, width, side, channels).sum(2)


def shares(light: Float[Tensor, "s 3"], counts: Float64[Tensor, " s"]) -> Float64[Tensor, " shares"]:
    """:data:`QUANTILES` quantiles, each the middle of an equal share, of linear light weighted by ``counts``."""
    codes = (linear_to_srgb(light.clamp(0, 1)) * (HISTOGRAM_BINS - 1)).round().int()
    below = torch.bincount(
        codes.flatten(), counts[:, None].expand_as(codes).flatten(), minlength=HISTOGRAM_BINS
    ).cumsum(0)
    middles = (torch.arange(QUANTILES).double() + 0.5) / QUANTILES * below[-1]
    return srgb_to_linear(torch.searchsorted(below, middles).double() / (HISTOGRAM_BINS - 1))


def factor_to_mean(levels: Float[Tensor, " n"], counts: Float[Tensor, " n"] | Int64[Tensor, " n"]) -> float:
    """The factor that brightens colours to the mean of :data:`TARGET_MEAN`, by bisection: the mean rises with it.

    Args:
        levels, counts: sRGB values in [0, 1] and how often each occurs.

    Returns:
        In [1, 1024]: 1 where the mean is reached as it is, and where all is black; 1024 where it is out of reach.
    """
    seen = counts > 0  # few of the levels of floats
    levels, shares = levels[seen].double(), counts[seen].double() / counts.sum().clamp(min=1)
    if not 0.0 < float((levels * shares).sum()) < TARGET_MEAN.at:
        return 1.0
    low, high = 0.0, float(MAX_STOPS)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        too_dark = float((brighten(levels, 2.0**middle) * shares).sum()) < TARGET_MEAN.at
        low, high = (middle, high) if too_dark else (low, middle)
    return 2.0**high
