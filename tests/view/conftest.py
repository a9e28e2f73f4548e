"""Small runs to look at."""

from pathlib import Path

import pytest

SMALL = ("trainer=smoke", "backbone.steps_alone=60", "backbone.coarse=false", "backbone.grow=[]")
DARK = ("dataset=blender", "dataset.exposure=0.05")


@pytest.fixture(scope="session")
def runs(ball, trained) -> dict[str, Path]:
    """The dark ball with CTM and without, 60 steps: a dark spot before a light ground."""
    data = (*DARK, f"dataset.root={ball}")
    kinds = {"on": ("ctm=quick", "ctm.pretrain_steps=20"), "off": ("ctm=off",)}
    return {name: trained(f"viewed_{name}", *data, *SMALL, *ctm) for name, ctm in kinds.items()}


@pytest.fixture(scope="session")
def forward_run(hall, trained) -> Path:
    """The hall, forward-facing, latents with four channels."""
    sizes = ("trainer=smoke", "backbone.steps_alone=5", "backbone.grow=[]", "backbone.planes=8")
    ctm = ("ctm=quick", "ctm.pretrain_steps=5", "ctm.k=4")
    return trained("viewed_forward", "dataset=llff", f"dataset.root={hall}", *sizes, *ctm)
