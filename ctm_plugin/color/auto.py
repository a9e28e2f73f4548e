"""The colours to train in where nobody wants to choose: a gain with a logarithm that bends mildly, fitted."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ctm_plugin.color.spaces import log
from ctm_plugin.settings.build import setting
from ctm_plugin.settings.check import check_number


@dataclass(frozen=True, kw_only=True)
class AutoConfig:
    """How far the curve may bend."""

    steepest: float = setting(3.0, "largest slope at black, in slopes at the brightest of the scene; 1: a gain alone")

    def __post_init__(self) -> None:
        check_number("ctm.steepest", self.steepest, lambda v: 1 <= v < math.inf, "a number >= 1")


class Auto(log.Space):
    """``color_space=log``, whose bend a is such that the slope at black, 1 + a times that at the level, is bounded.

    Colours as bright as a normal picture's, whose level is 0.9 and whose median above its half, are left as they are.
    The darker half of the scene weighs more than under a gain, so that it holds when it is brightened; the bound keeps
    it from weighing so much that the brighter half suffers (``docs/results.md``, colours).
    """

    Config = AutoConfig

    def __init__(self, config: AutoConfig | None = None):
        super().__init__(config)
        self.bounds = (self.bounds[0], max(self.config.steepest - 1, self.bounds[0]))
