"""Splats of a tiny scene, and runs of them: what tests of their loss, growth and schedule share."""

from pathlib import Path
from typing import Any

import pytest
from torch import Tensor

from ctm_plugin.backbones.settings import SplatConfig
from ctm_plugin.backbones.splat import Splat
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.errors import Interrupted
from ctm_plugin.runs.train import resume, train
from ctm_plugin.scene.views import Scene

SPLAT = ("backbone=splat", "trainer.image_every=null")
GROWS = ("backbone.threshold=1e-6", "backbone.per_pixel=0.075")
"""By which next to all Gaussians are doubled, up to 432."""


def make(scene: Scene, kind: str = "l1", weight: float = 1.0, **settings: Any) -> Splat:
    """Of 80 Gaussians at most, as it is before the first step."""
    module = Splat(SplatConfig(**{"first": 80} | settings), scene, photometric=Photometric(kind=kind, weight=weight))
    module.on_train_start()
    return module


def stepped(module: Splat) -> dict[str, Tensor]:
    """A training step's terms; its gradients are in the tables."""
    module.training_step(None, 0)["loss"].backward()
    module.on_after_backward()
    return module.terms


def interrupted(config: dict[str, Any], run: Path, ctrl_c: Any, batch: int) -> None:
    """Train, stopped in the middle of a batch and gone on with."""
    ctrl_c(lambda seen: seen == batch)
    with pytest.raises(Interrupted):
        train(config, run)
    ctrl_c(lambda seen: False)
    resume(run)
