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
    """How far the curve may bend."""

    steepest: float = setting(3.0, "largest slope at black, in slopes at the brightest of the scene; 1: a gain alone")

    def __post_init__(self) -> None:
        check_number("ctm.steepest", self.steepest, lambda v: 1 <= v < math.inf, "a number >= 1")


class Auto(log.Space):
    """``y = 0.5 h(c / level)``, ``h(u) = log(1 + a u) / log(1 + a)``, whose bend a is bounded.

    - The bend is that of ``color_space=log``, but the slope at black, 1 + a times that at the level, is ``steepest`` at
      most: the darker half of the scene weighs more than under a gain, so that it holds when it is brightened, but not
      so much that the brighter half suffers.
    - The scene fills the lower half of the latents, where a sigmoid's logit is much like a logarithm: steps are then in
      proportion to the light. Brighter colours than the training's are in reach.
    - Scenes whose level is above 0.5 and whose median above half of it stay as they are.

    What each is worth: ``docs/results.md``, colours in the dark.
    """

    Config = AutoConfig
    top = 0.5

    def __init__(self, config: AutoConfig | None = None):
        super().__init__(config)
        self.bounds = (self.bounds[0], max(self.config.steepest - 1, self.bounds[0]))

    @property
    def filled(self) -> Tensor:
        return torch.where(self.level < self.top, self.top, 1.0)
