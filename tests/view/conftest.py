"""Small runs to look at."""

from pathlib import Path

import pytest

from ctm_plugin.cli import main as train

SIZES = ("trainer=smoke", "backbone.steps_alone=60", "backbone.coarse=false", "backbone.grow=[]")


@pytest.fixture(scope="session")
def runs(ball, once) -> dict[str, Path]:
    """The dark ball with CTM and without, 60 steps: a dark spot before a light ground."""
    data = ("dataset=blender", f"dataset.root={ball}", "dataset.exposure=0.05")

    def make(folder: Path) -> None:
        for name, ctm in (("on", ("ctm=quick", "ctm.pretrain_steps=20")), ("off", ("ctm=off",))):
            assert train([*data, *SIZES, *ctm, f"hydra.run.dir={folder / name}"]) == 0

    folder = once("viewed", make)
    return {name: folder / name for name in ("on", "off")}


@pytest.fixture(scope="session")
def forward_run(hall, once) -> Path:
    """The hall, forward-facing, latents with four channels."""
    sizes = ("trainer=smoke", "backbone.steps_alone=5", "backbone.grow=[]", "backbone.planes=8")
    ctm = ("ctm=quick", "ctm.pretrain_steps=5", "ctm.k=4")
    data = ("dataset=llff", f"dataset.root={hall}")

    def make(folder: Path) -> None:
        assert train([*data, *sizes, *ctm, f"hydra.run.dir={folder}"]) == 0

    return once("viewed_forward", make)


@pytest.fixture(scope="session")
def splat_run(ball, once) -> Path:
    """The dark ball in Gaussian splats, rendered as whole pictures."""
    data = ("dataset=blender", f"dataset.root={ball}", "dataset.exposure=0.05", "dataset.background=black")
    sizes = ("backbone=splat", "trainer=smoke", "backbone.steps=150", "ctm=auto")

    def make(folder: Path) -> None:
        assert train([*data, *sizes, f"hydra.run.dir={folder}"]) == 0

    return once("viewed_splats", make)
