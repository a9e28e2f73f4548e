"""The colours to train in where nobody wants to choose: sRGB, raised and mildly bent where the scene asks for it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ctm_plugin.color.spaces import log
from ctm_plugin.settings.build import setting
from ctm_plugin.settings.check import check_number

STRAIGHT = 1e-9
"""A bend that float32 does not see."""


@dataclass(frozen=True, kw_only=True)
class AutoConfig:
    """How far the curve bends, and how much of the latents a dark scene fills."""

    steepest: float = setting(3.0, "largest slope at black, in slopes at the brightest of the scene; 1: a gain alone")
    middle: float = setting(
        0.5, "where the curve brings the scene's median, of the brightest's 1; no bend where it is above"
    )
    fills: float = setting(0.5, "dark scenes are encoded as [0, this] at least, in (0, 0.5]")

    def __post_init__(self) -> None:
        check_number("ctm.steepest", self.steepest, lambda v: 1 <= v < math.inf, "a number >= 1")
        check_number("ctm.middle", self.middle, lambda v: 0 < v < 1, "a number in (0, 1)")
        check_number("ctm.fills", self.fills, lambda v: 0 < v <= Auto.brightest, f"a number in (0, {Auto.brightest}]")


class Auto(log.Space):
    """``y = top h(c / level)``, ``h(u) = log(1 + a u) / log(1 + a)``, whose bend a is bounded.

    - The bend brings the median to ``middle``, but the slope at black, 1 + a times that at the level, is ``steepest``
      at most: the darker half of the scene weighs more than under a gain, so that it holds when it is brightened, but
      not so much that the brighter half suffers. Scenes whose median is above ``middle`` anyway are not bent.
    - The level stays where it is in sRGB, or is raised to ``fills``. Low in the latents a sigmoid is an exponential:
      steps are then in proportion to the light. Brighter colours than the training's are in reach.
    - What is neither raised nor bent is sRGB to the last bit, lit scenes above all.

    What each is worth: ``docs/results.md``, colours in the dark.
    """

    Config = AutoConfig
    brightest = 0.5

    def __init__(self, config: AutoConfig | None = None):
        super().__init__(config)
        self.middle = self.config.middle
        self.bounds = (STRAIGHT, max(self.config.steepest - 1, STRAIGHT))

    @property
    def top(self) -> Tensor:
        return self.level.clamp_min(self.config.fills)

    @property
    def filled(self) -> Tensor:
        return torch.where(self.level < self.brightest, self.top, 1.0)
