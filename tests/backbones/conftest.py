from pathlib import Path
from typing import Any

import pytest
import torch
from splat_runs import GROWS, SPLAT

from ctm_plugin.runs.train import train
from ctm_plugin.scene.views import Scene, Views


@pytest.fixture(scope="session")
def wall() -> Scene:
    """A forward-facing scene: cameras in a plane that look along -z, with noise for pictures."""
    random = torch.Generator().manual_seed(0)
    c2w = torch.eye(3, 4).repeat(6, 1, 1)
    c2w[:, :2, 3] = 0.3 * torch.randn(6, 2, generator=random)
    images = torch.randint(256, (6, 8, 10, 3), generator=random, dtype=torch.uint8)
    views = Views(images, c2w, torch.tensor([[9.0, 9.0, 5.0, 4.0]]).repeat(6, 1), tuple("abcdef"))
    return Scene("wall", views, views, near=1.0, far=20.0, geometry="forward", background="black")


@pytest.fixture(scope="session")
def grown(compose, tmp_path_factory) -> tuple[dict[str, Any], Path]:
    """20 steps of two batches; growth at 5, 10 and 15, all nearly transparent at 10; its whole run."""
    config = compose(
        *SPLAT, *GROWS, "ctm.pretrain_steps=20", "trainer.accumulate_grad_batches=2", "appearance=exposure",
        "dataset.background=random_matched", "backbone.lr_opacities=0.2", "backbone.first=100",
    )  # fmt: skip
    run = tmp_path_factory.mktemp("grown") / "whole"
    train(config, run)
    return config, run
