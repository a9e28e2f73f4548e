"""The colours to train in where nobody wants to choose: a gain with a logarithm that bends mildly, fitted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ctm_plugin.color.spaces import log
from ctm_plugin.settings.build import setting
from ctm_plugin.settings.check import check_number


@dataclass(frozen=True, kw_only=True)
class AutoConfig:
    """How far the curve may bend, and how much of the latents a dark scene fills."""

    steepest: float = setting(3.0, "largest slope at black, in slopes at the brightest of the scene; 1: a gain alone")
    fills: float = setting(0.5, "dark scenes are encoded as [0, this] at least, in (0, 0.5]")

    def __post_init__(self) -> None:
        check_number("ctm.steepest", self.steepest, lambda v: 1 <= v < math.inf, "a number >= 1")
        check_number("ctm.fills", self.fills, lambda v: 0 < v <= Auto.brightest, f"a number in (0, {Auto.brightest}]")


class Auto(log.Space):
    """``y = top h(c / level)``, ``h(u) = log(1 + a u) / log(1 + a)``, whose bend a is bounded.

    - The bend is that of ``color_space=log``, but the slope at black, 1 + a times that at the level, is ``steepest`` at
      most: the darker half of the scene weighs more than under a gain, so that it holds when it is brightened, but not
      so much that the brighter half suffers.
    - The level stays where it is in sRGB, or is raised to ``fills``. Low in the latents a sigmoid is an exponential:
      steps are then in proportion to the light. Brighter colours than the training's are in reach.
    - Scenes whose level is above 0.5 and whose median above half of it stay as they are.

    What each is worth: ``docs/results.md``, colours in the dark.
    """

    Config = AutoConfig
    brightest = 0.5

    def __init__(self, config: AutoConfig | None = None):
        super().__init__(config)
        self.bounds = (self.bounds[0], max(self.config.steepest - 1, self.bounds[0]))

    @property
    def top(self) -> Tensor:
        return self.level.clamp_min(self.config.fills)

    @property
    def filled(self) -> Tensor:
        return torch.where(self.level < self.brightest, self.top, 1.0)
