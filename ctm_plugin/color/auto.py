"""The recommended colours to train in: sRGB, raised and bent as the scene's colours need it."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.color.curves import Number, as_given
from ctm_plugin.color.settings import AutoConfig
from ctm_plugin.color.spaces import log
from ctm_plugin.color.srgb import Colors, srgb_slope

MIN_BEND = 1e-9
"""Bend that float32 cannot tell from a straight line."""
SRGB_BEND = 2.0
"""Ratio of sRGB's slope at black to its slope at 1/100 of white."""
BLACK_MARGIN = 0.1
"""Range of the random backgrounds round black, as a share of the range that the scene fills."""


class Auto(log.Space):
    """``y = b + t h(c / level)``, ``h(u) = log(1 + a u) / log(1 + a)``, bent where that pays.

    - Where a part ``empty`` of a dark scene is black, the bend brings the median to ``middle``, but the slope at black,
      1 + a times that at the level, is ``steepest`` at most: haze in front of what is black, which shows when pictures
      are brightened, costs more than under a gain, but not so much that the brighter half suffers. Scenes whose median
      is above ``middle`` anyway are not bent, nor those without black, where that is worth little and may cost.
    - Below 1/100 of normal light sRGB, straight near black, bends less and less itself: all may be bent by
      :func:`toe` more.
    - A median that would stay below ``lowest`` is brought there: next to a lamp all else is a few grey levels.
    - t: the level stays as far above black as it is in sRGB, or is raised to ``fills`` if it is below 0.5. Brighter
      colours than the training's are in reach.
    - ``b = black t``: a field's sigmoid reaches black at a finite logit, where it still learns. At 0 it never does, and
      nearly black colours learn slowly.
    - Scenes whose level is 0.5 or more are sRGB to the last bit, unless a lamp keeps their median below ``lowest``.

    What each is worth: ``docs/evidence/tried.csv``, colours.
    """

    Config = AutoConfig
    brightest = 0.5

    def __init__(self, config: AutoConfig | None = None):
        super().__init__(config)
        self.middle = self.config.middle
        self.register_buffer("places", torch.zeros(5), persistent=False)
        self.register_buffer("slopes", torch.zeros(2, dtype=torch.float64), persistent=False)
        self._place()
        self.register_load_state_dict_post_hook(lambda loaded, _: loaded._place())

    def begin(self, rgb: Float[Tensor, "n 3"]) -> None:
        black = (rgb.amax(-1) == 0).double().mean()
        self.steepest = self.config.steepest if black >= self.config.empty else 1.0
        super().begin(rgb)
        self._place()

    def bend_for(self, median: Number, middle: float, bounds: tuple[float, float]) -> float:
        mild, furthest = MIN_BEND, bounds[1]
        if self.level < self.brightest:
            limit = self.steepest + toe(float(self.level)) - 1
            mild = super().bend_for(median, middle, (MIN_BEND, max(limit, MIN_BEND)))
        return max(mild, super().bend_for(median, min(self.config.lowest, middle), (MIN_BEND, furthest)))

    def encode(self, rgb: Colors) -> Colors:
        # The base's, with half its operators: the small ones are what a step on a GPU waits for.
        return as_given(self.black + self.slopes[0] * torch.log1p(self.slopes[1] * rgb.double()), rgb)

    def _place(self) -> None:
        """Cache values derived from the fit: computing them at every use was a tenth of a step's operators.

        What black is encoded as, the range above it, where what is filled ends, and the ends of backgrounds: round
        black, so that they do not push colours to one side of it, and near, as all that is empty has to come near them.
        """
        top = self.level.clamp_min(self.config.fills)
        black = self.config.black * top
        near = torch.minimum(black, top * BLACK_MARGIN)
        behind = (black - near, black + near) if self.config.black else (black, black + top)
        self.places.copy_(torch.stack([black, top, black + top, *behind]))
        if self.level >= self.brightest:
            self.places.copy_(torch.tensor([0.0, self.brightest, 1.0, 0.0, 1.0]))
        a = self.a.double()
        self.slopes.copy_(torch.stack([self.top.double() / torch.log1p(a), a / self.level.double()]))

    black = property(lambda self: self.places[0])
    top = property(lambda self: self.places[1])
    filled = property(lambda self: (self.places[0], self.places[2]))
    behind = property(lambda self: (self.places[3], self.places[4]))

    def describe(self) -> str:
        black = f", black at {float(self.black):.2g}" if self.black > 0 else ""
        return super().describe() + black


def toe(level: float) -> float:
    """Extra bend allowed below 1/100 of white, where sRGB bends less: ``4 (2 s(L) / s(0) - 1)``, >= 0.

    s is :func:`~ctm_plugin.color.srgb.srgb_slope`: the darker a scene is, the more its colours are light itself.
    """
    return 4 * max(0.0, SRGB_BEND * srgb_slope(level) / srgb_slope(0.0) - 1)
