"""What a failure in the dark depends on: the command line, with colours that start at the scene's mean.

``python benchmarks/mean_start.py backbone=nerf ctm=off dataset.exposure=0.02 ...``, or ``backbone=barf2d``.

Both start near grey. Before a black background a dark scene is then brighter than its pictures everywhere, and NeRF's
fastest way to less light is less density; where a ReLU has none left, no gradient brings it back. A picture that has to
come down from grey drives its sigmoid to where it has no gradient.
"""

from __future__ import annotations

import sys

import torch

from ctm_plugin.backbones import barf2d, nerf
from ctm_plugin.backbones.base import Backbone
from ctm_plugin.cli import main
from ctm_plugin.draws import Draws


class _FromTheMean(Backbone):
    """The last layers begin at the mean encoded training colour, as DVGO's does."""

    @torch.no_grad()
    def on_train_start(self) -> None:
        if self.batches_seen == 0:
            colors = self.scene_colors(Draws(self.seed, -1, self.device), 1 << 15)
            bias = self.transform.encode(colors).mean(0).logit(eps=1e-3)
            for last in self.last_layers():
                last.bias.copy_(bias)


class StartedNeRF(_FromTheMean, nerf.NeRF):
    def last_layers(self) -> list[torch.nn.Linear]:
        return [self.coarse.color, self.fine.color]


class StartedBARF2D(_FromTheMean, barf2d.BARF2D):
    def last_layers(self) -> list[torch.nn.Linear]:
        return [self.image.layers[-1]]


if __name__ == "__main__":
    nerf.NeRF, barf2d.BARF2D = StartedNeRF, StartedBARF2D  # the registry imports them by name
    sys.exit(main())
