"""DVGO on a forward-facing scene, a painted wall and a board in front of it (``hall``)."""

import json

import pytest
import torch

from ctm_plugin.backbones.dvgo_bounded import BoundedDVGO
from ctm_plugin.backbones.dvgo_forward import ForwardDVGO
from ctm_plugin.errors import ConfigError
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.train import train

WALL, BOARD = 6.0, 3.0


@pytest.fixture
def llff(hall, compose):
    return lambda *more: compose("dataset=llff", f"dataset.root={hall}", "backbone=dvgo", *more)


SIZES = (
    "backbone.planes=24",
    "backbone.voxels=24000",
    "backbone.grow=[40]",
    "backbone.rays=256",
    "backbone.steps_alone=120",
    "backbone.tv_dense_steps=80",
    "backbone.lr_grid=0.3",
    "backbone.lr_mlp=0.003",
    "backbone.occupancy_first=25",
)


def test_learns_colours_and_depth(llff, tmp_path):
    """With CTM, under which less of it is certain."""
    train(llff(*SIZES, "ctm=quick", "ctm.pretrain_steps=200"), tmp_path / "run")
    result = json.loads((tmp_path / "run" / "metrics.json").read_text())
    # The wall's mean colour alone gives about 10 dB, the mean depth an error of 0.75 x the spread of the depths.
    assert result["psnr"] > 22
    scale = 1 / (0.75 * (BOARD - 0.5))
    assert result["depth_mae"] < 0.3 * (WALL - BOARD) * scale


def test_the_geometry_of_the_data_picks_the_class_and_the_paper_s_sizes(llff, compose):
    forward = assemble(llff("trainer=paper", "backbone.voxels=8000", "backbone.planes=8")).backbone
    assert type(forward) is ForwardDVGO
    config = forward.config
    assert (config.features, forward.mlp_width, config.rays, config.threshold) == (9, 64, 4096, 1e-3)
    assert (config.step_size, config.grow, forward.total_steps) == (0.5, (2000, 4000, 6000, 8000), 30000)
    assert type(assemble(compose("backbone=dvgo")).backbone) is BoundedDVGO


def test_saying_which(llff, compose):
    assert type(assemble(llff("backbone.geometry=bounded")).backbone) is BoundedDVGO
    assert type(assemble(llff("backbone.geometry=forward")).backbone) is ForwardDVGO
    with pytest.raises(ConfigError, match=r"backbone\.coarse: found True, expected false or auto"):
        assemble(llff("backbone.coarse=true"))


def test_unbounded_scenes_are_not_supported_yet(llff):
    with pytest.raises(ConfigError, match=r"backbone\.geometry: found 'unbounded', expected bounded or forward"):
        assemble(llff("dataset.geometry=unbounded"))


def test_a_data_set_that_does_not_say_its_geometry(llff):
    config = llff()
    config["backbone"]["geometry"] = None
    with pytest.raises(ConfigError, match="given as a key: hall is forward"):
        assemble(config)


def test_planes_keep_their_number_when_the_grid_grows(llff):
    module = assemble(llff("backbone.planes=16", "backbone.voxels=32000", "backbone.grow=[5, 10]")).backbone
    shapes = []
    for grown in range(3):
        module.grown = grown
        shapes.append(module.grown_shape(module.field.grid.box))
    assert [shape[2] for shape in shapes] == [16] * 3
    assert shapes[0][0] * shapes[0][1] < shapes[1][0] * shapes[1][1] < shapes[2][0] * shapes[2][1]
    torch.testing.assert_close(module.field.grid.box[:, 2], torch.tensor([-1.0, 1.0]))
