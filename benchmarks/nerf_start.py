"""What NeRF's failure in the dark depends on: the command line, with colours that start at the scene's mean.

``python benchmarks/nerf_start.py backbone=nerf ctm=off dataset.exposure=0.02 ...``

NeRF's colours start near grey. Before a black background a dark scene is then brighter than its pictures everywhere,
and the fastest way to less light is less density; where a ReLU has none left, no gradient brings it back.
"""

from __future__ import annotations

import sys

import torch

from ctm_plugin.backbones import nerf
from ctm_plugin.cli import main
from ctm_plugin.draws import Draws


class StartedNeRF(nerf.NeRF):
    """NeRF whose last layer begins at the mean encoded training colour, as DVGO's does."""

    @torch.no_grad()
    def on_train_start(self) -> None:
        if self.batches_seen == 0:
            colors = self.scene_colors(Draws(self.seed, -1, self.device), 1 << 15)
            bias = self.transform.encode(colors).mean(0).logit(eps=1e-3)
            for field in (self.coarse, self.fine):
                field.color.bias.copy_(bias)


if __name__ == "__main__":
    nerf.NeRF = StartedNeRF  # the registry imports it by name
    sys.exit(main())
