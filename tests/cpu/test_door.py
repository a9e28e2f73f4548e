"""Every function with a loop: the loop against the plain torch version beside the maths, which GPUs run."""

import importlib
import pkgutil
import sys
from collections.abc import Callable
from typing import Any

import numba
import pytest
import torch
from forked import Command, execute
from gaussian_scenes import FLOOR, certain, setting
from tolerance import assert_within, gamma
from torch import Tensor

import ctm_plugin
from ctm_plugin import door
from ctm_plugin.rays.grid import VoxelGrid
from ctm_plugin.rays.hash_grid import HashGrid

LATTICE = VoxelGrid(torch.tensor([[-1.0] * 3, [1.0, 1.2, 0.9]]), (6, 7, 8))
BUFFERS = LATTICE.aabb[0], LATTICE.scale, LATTICE.last, LATTICE.offsets
HASHED = HashGrid(3, 2, 256, 4, 16)
RAYS, SAMPLES = 20, 15


def rand(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def of_bends() -> tuple:
    return rand(30, 20).requires_grad_(), rand(30, 20, seed=1), 0.1 * rand(30, 20, 3, seed=2)


def of_volume_weights() -> tuple:
    return (3 * rand(RAYS * SAMPLES)).requires_grad_(), torch.arange(RAYS).repeat_interleave(SAMPLES), RAYS


def of_corners() -> tuple:
    return 2.4 * rand(200, 3) - 1.2, *BUFFERS


def of_occupied_samples() -> tuple:
    directions = torch.nn.functional.normalize(rand(RAYS, 3, seed=1) - 0.5, dim=1)
    counts = torch.full((RAYS,), SAMPLES)
    # Half of them none at all: there are blocks that are passed in one go.
    occupancy = (rand(LATTICE.count, seed=2) < 0.5) & (LATTICE.vertices()[:, 0] > 0)
    return rand(RAYS, 3) - 0.5, directions, rand(RAYS, seed=3), counts, 0.05, occupancy, *BUFFERS


def of_weighted() -> tuple:
    return rand(LATTICE.count, 1), *LATTICE.corners(rand(200, 3))


def of_scattered() -> tuple:
    return *LATTICE.corners(0.2 * rand(200, 3)), rand(200, 3) - 0.5, torch.Size([LATTICE.count, 3]), False


def of_encoded() -> tuple:
    return rand(HASHED.table.shape[0], 2), rand(200, 3), HASHED.sides, HASHED.starts


def of_spread() -> tuple:
    return rand(200, 6) - 0.5, rand(200, 3, seed=1), HASHED.sides, HASHED.starts, HASHED.table.shape


def of_log_density() -> tuple:
    torch.manual_seed(0)
    table = rand(HASHED.table.shape[0], 2) - 0.5
    return table, HASHED.sides, HASHED.starts, torch.nn.Linear(6, 18), torch.nn.Linear(18, 5), rand(700, 3)


def of_lit() -> tuple:
    """Rays of none to many samples, some of which no light reaches."""
    ray_index = (40 * rand(700, seed=1).square()).long().sort().values
    return *of_log_density(), 0.4 * rand(700, seed=2), ray_index, 40, 0.01


def of_step_table() -> tuple:
    grad = (rand(50, 3) - 0.5) * (rand(50, 1, seed=1) > 0.3)
    moments = rand(50, 3, seed=2) - 0.5, rand(50, 3, seed=3)
    return rand(50, 3, seed=4), grad, *moments, rand(50, 1, seed=5), 3, 0.1, (0.9, 0.99), 1e-8


def of_dssim() -> tuple:
    return rand(3, 20, 17).requires_grad_(), rand(3, 20, 17, seed=1)


def of_picture() -> tuple:
    of = setting(20, degrees=2, width=20, height=18, seed=5)
    assert certain(of.projected(), of.camera, 1e-3).all()  # on which side of a bound rounding puts a pixel, all see
    tables = type(of.gaussians)(*(each.requires_grad_() for each in of.gaussians))
    return tables, of.camera, torch.zeros(20, 2, requires_grad=True), 2, FLOOR, 0


CASES: dict[str, tuple[Callable[[], tuple], int]] = {
    "ctm_plugin.rays.volume.volume_weights": (of_volume_weights, 4 * SAMPLES),
    "ctm_plugin.rays.grid.corners": (of_corners, 8),
    "ctm_plugin.rays.occupancy.occupied_samples": (of_occupied_samples, 4),
    "ctm_plugin.rays.grid.weighted": (of_weighted, 8),
    "ctm_plugin.rays.grid.scattered": (of_scattered, 8 * 200),
    # Positions in the finest cells are off by what they are rounded to, 16 times that of the weights.
    "ctm_plugin.rays.hash_grid.encoded": (of_encoded, 16 * 8),
    "ctm_plugin.rays.hash_grid.spread": (of_spread, 16 * 8 * 200),
    "ctm_plugin.rays.hash_density.log_density": (of_log_density, 16 * 8 + 6 + 18),
    "ctm_plugin.rays.hash_density.visible_samples": (of_lit, 16 * 8),
    "ctm_plugin.optim.grid_adam.step_table": (of_step_table, 12),
    # Windows of 11 x 11, there and back; a variance is a difference.
    "ctm_plugin.color.dssim.dssim": (of_dssim, 8 * 2 * 11),
    # Gradients are sums over the pixels that a Gaussian reaches, of what lies behind each, another sum.
    "ctm_plugin.splats.render.picture": (of_picture, 16 * 20),
    # A sum over all pixels, of weights that a polynomial gives.
    "ctm_plugin.splats.render.bends": (of_bends, 30 * 20 + 64),
}
"""Arguments of each, and how many roundings one after another a result may have; arguments may be changed in place."""


def leaves(of: Any) -> list[Tensor]:
    """All tensors in arguments or results."""
    of = list(of.values()) if isinstance(of, dict) else of
    if isinstance(of, list | tuple):
        return [leaf for each in of for leaf in leaves(each)]
    return list(door._tensors([of]))


def results(function: Callable, arguments: tuple) -> list[Tensor]:
    """What it returns, its arguments afterwards, and all gradients of a sum."""
    found = function(*arguments)
    of_loss = [each for each in leaves(found) if each.requires_grad]
    if of_loss:
        sum((each * (each.detach() + 0.5)).sum() for each in of_loss).backward()
    given = leaves(arguments)
    return [*leaves(found), *given, *(each.grad for each in given if each.grad is not None)]


def test_every_function_has_a_case():
    for module in pkgutil.walk_packages(ctm_plugin.__path__, "ctm_plugin."):
        if module.name.split(".")[1] in ("rays", "optim", "color", "backbones"):
            importlib.import_module(module.name)
    assert {name for name, call in door.registered.items() if call.loop} == CASES.keys()


@pytest.mark.parametrize("name", CASES)
def test_the_loop_is_the_plain_version(name):
    arguments, roundings = CASES[name]
    function, ran = door.registered[name], []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(numba, "set_num_threads", ran.append)  # before each loop
        found = results(function, arguments())
        assert ran, "the loop has not run"
        patch.setattr(door, "may_run", lambda _: False)  # nor inside it
        expected = results(function.reference, arguments())
    assert len(found) == len(expected)
    for ours, plain in zip(found, expected, strict=True):
        assert (ours.shape, ours.dtype) == (plain.shape, plain.dtype)
        ours, plain = ours.detach().double(), plain.detach().double()
        assert_within(ours, plain, 2 * gamma(roundings, torch.float32) * plain.abs().max())


@pytest.mark.parametrize("arguments", [(torch.ones(2).double(),), (torch.ones(2, device="meta"), [torch.ones(2)])])
def test_loops_are_for_float32_on_the_cpu(arguments):
    assert not door.may_run(arguments)
    assert door.may_run([torch.ones(2), [torch.ones(2, dtype=torch.int64)], torch.nn.Linear(2, 2)])


def test_without_numba(monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)
    assert not door._compiles.__wrapped__()


def test_numba_comes_with_the_first_loop(tmp_path):
    """Every module but the loops' and kernels' own imports without it; what an extra brings may be missing."""
    script = (
        "import importlib, pkgutil, sys, ctm_plugin\n"
        "for module in pkgutil.walk_packages(ctm_plugin.__path__, 'ctm_plugin.'):\n"
        "    if module.name.startswith(('ctm_plugin.cpu.', 'ctm_plugin.gpu.')) or module.name.endswith('__main__'):\n"
        "        continue\n"
        "    try:\n"
        "        importlib.import_module(module.name)\n"
        "    except ModuleNotFoundError as error:\n"
        "        assert error.name.split('.')[0] in ('viser', 'rawpy', 'imageio_ffmpeg'), error\n"
        "print(sorted({'numba', 'llvmlite'} & sys.modules.keys()))\n"
    )
    output, error = Command(script, main=execute, told=tmp_path / "told").communicate()
    assert output == "[]\n", error
