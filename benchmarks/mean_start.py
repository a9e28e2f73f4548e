"""What a failure in the dark depends on: planar alignment with colours that start at the picture's mean.

``python benchmarks/mean_start.py backbone=barf2d ctm=off dataset.exposure=0.02 ...``

BARF's start near grey: a dark picture that has to come down from there drives its sigmoid to where it has no gradient.
NeRF and DVGO start at the mean by themselves (``backbone.start``).
"""

from __future__ import annotations

import sys

from torch import Tensor

from ctm_plugin.backbones import barf2d
from ctm_plugin.cli import main


class StartedBARF2D(barf2d.BARF2D):
    """The last layer begins at the mean encoded training colour."""

    def color_biases(self) -> list[Tensor]:
        return [self.image.layers[-1].bias]


if __name__ == "__main__":
    barf2d.BARF2D = StartedBARF2D  # the registry imports it by name
    sys.exit(main())
