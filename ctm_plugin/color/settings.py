"""The settings of colour transforms, of their training and of the loss; torch is not needed to check them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ctm_plugin.errors import ConfigError
from ctm_plugin.settings.setting import Settings, setting

LOSS_KINDS = ("mse", "l1")
"""Distances between colours: squared and absolute differences."""
MAX_STOPS = 10
"""Largest number of stops of light: it makes the darkest level of 8 bits above black a middle grey."""


CONTRASTS, SATURATIONS = (0.5, 2.0), (0.0, 2.0)
"""Least and largest contrast, and saturation, of lit pictures."""


def stops_of(light: str | float | None) -> float | None:
    """The stops that a setting ``light`` means: 0 for ``off``, ``None`` for ``auto`` and ``None``, which finds them.

    Raises:
        ConfigError: it is neither, and no number from -10 to 10.
    """
    if light in (None, "auto", "off"):
        return 0.0 if light == "off" else None
    try:
        stops = float(light)
    except ValueError:
        stops = math.nan
    if not abs(stops) <= MAX_STOPS:
        raise ConfigError("light", light, f"auto, off, or a number of stops, -{MAX_STOPS} to {MAX_STOPS}")
    return stops


@dataclass(frozen=True, kw_only=True)
class LightConfig(Settings):
    """Brightness and vividness of displayed pictures."""

    light: str = setting(
        "auto",
        "brightening: auto (like a camera's, found from the training pictures), a number of stops without more "
        "contrast or colour, or off",
    )
    contrast: float | None = setting(
        None,
        "contrast of lit pictures; 1: as photographed; null: as found by light=auto, else 1",
        least=CONTRASTS[0],
        most=CONTRASTS[1],
    )
    saturation: float | None = setting(
        None,
        "saturation of lit pictures; 1: as photographed, 0: grey; null: as found by light=auto, else 1",
        least=SATURATIONS[0],
        most=SATURATIONS[1],
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        stops_of(self.light)


AUTO_LIGHT = LightConfig()
"""The light that is found from the training pictures."""


@dataclass(frozen=True, kw_only=True)
class LossConfig(Settings, section="loss"):
    """The distance between colours."""

    kind: str = setting(
        "mse",
        "mse: squared differences; l1: absolute differences",
        composed="${oc.select:backbone.photometric,${oc.select:ctm.photometric,mse}}",
        choices=LOSS_KINDS,
    )
    weight: float = setting(1.0, "factor on every photometric term", least=0)


@dataclass(frozen=True, kw_only=True)
class TransformTraining(Settings, section="ctm"):
    """Training of a learned transform. The defaults are the paper's for NeRF and DVGO."""

    lr: float = setting(5e-4, "learning rate of the transform", above=0)
    betas: tuple[float, float] = setting((0.9, 0.999), "the two decay factors of the transform's Adam")
    lr_decay: float = setting(1.0, "factor that lr falls to by the last step, exponentially", above=0, most=1)
    pretrain_steps: int = setting(
        0,
        "steps of pre-training, which trains the transform on its cycle losses only, before there is a field",
        least=0,
    )
    pretrain_lr: float | None = setting(
        None,
        "learning rate at the first step of pre-training, from which it falls exponentially to lr; null: lr",
        above=0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.betas) != 2 or not all(0 <= beta < 1 for beta in self.betas):
            raise self.fault("betas", "two numbers in [0, 1)")


@dataclass(frozen=True, kw_only=True)
class LossWeights(Settings, section="ctm.weights"):
    """Weights of the five terms (Eq. 4, 5, 8, 9, 10); 0 leaves a term out.

    The defaults are the paper's for NeRF and DVGO.
    """

    enc: float = setting(
        1.0, "weight of |F(r) - f(C)|^2: rendered latent F(r) against encoded training colour f(C)", least=0
    )
    dec: float = setting(1.0, "weight of |g(F(r)) - C|^2: decoded rendering g(F(r)) against training colour C", least=0)
    img: float = setting(
        10000.0, "weight of |C - g(f(C))|^2: training colours against themselves, encoded and decoded", least=0
    )
    rand: float = setting(10.0, "weight of the same of random colours", least=0)
    latent: float = setting(
        100.0, "weight of |l - f(g(l))|^2: random latents against themselves, decoded and encoded", least=0
    )


@dataclass(frozen=True, kw_only=True)
class CTMConfig(Settings, section="ctm"):
    """Size and losses of CTM. The defaults are the paper's, but for ``init``, which it does not give."""

    k: int = setting(3, "number of latent channels", least=1)
    P: int = setting(4, "frequencies of the colour embedding; 0: the plain colour", least=0)
    width: int = setting(64, "width of the encoder's and the decoder's hidden layers", least=1)
    depth: int = setting(1, "number of hidden layers of the encoder and of the decoder", least=1)
    frequency: str = setting(
        "pi",
        "embedding of colours c: pi for sin(2^p pi c), as the paper prints it, or unit for sin(2^p c), as in the "
        "released code",
        choices=("pi", "unit"),
    )
    weights: LossWeights = setting(LossWeights(), "weight of each loss term; 0 leaves the term out")
    reduction: str = setting(
        "sum",
        "how losses combine channels: sum, as the paper prints it, or mean, as in the released code",
        choices=("sum", "mean"),
    )
    random_colors: int | None = setting(
        None, "random colours, and random latents, a step; null: as many as rays", least=1
    )
    init: str = setting(
        "random",
        "networks before the first step: random, or range (nearly an affine map from the scene's range of colours "
        "to the latent cube)",
        choices=("random", "range"),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.init == "range" and self.width < max(3, self.k):
            raise self.fault("width", f"an integer >= {max(3, self.k)}, with ctm.init=range")


@dataclass(frozen=True, kw_only=True)
class AutoConfig(Settings, section="ctm"):
    """Bend of the curve, and the latents that a dark scene gets."""

    steepest: float = setting(
        4.0,  # a steeper curve costs PSNR, a flatter one shows haze in brightened pictures
        "largest ratio of the slope at black to that at the scene's brightest colour (1: a gain); up to 4 more in "
        "the dark",
        least=1,
    )
    empty: float = setting(
        0.25,
        "least share of black among the scene's colours at which the curve bends; 0: it always bends",
        least=0,
        most=1,
    )
    middle: float = setting(
        0.45,
        "latent of the scene's median colour, as a share of the brightest colour's; a median above it needs no bend",
        above=0,
        below=1,
    )
    lowest: float = setting(
        0.2,
        "least latent of the median colour; the curve may exceed steepest for it (scenes with a lamp)",
        least=0,
        below=1,
    )
    fills: float = setting(0.1, "least range of latents that a dark scene's colours are spread over", above=0, most=0.9)
    black: float = setting(
        0.7, "latent of black in dark scenes, as a share of fills or of the larger range that is used", least=0, most=1
    )
    photometric: str = setting(
        "mse", "distance between colours where loss=auto: mse (squared) or l1 (absolute)", choices=LOSS_KINDS
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        limit = 1 / max(self.fills, 0.5) - 1  # black and the range above it end at 1
        if self.black > limit:
            raise self.fault("black", f"a number in [0, {limit:.3g}], with ctm.fills={self.fills}")
