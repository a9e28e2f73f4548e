"""Voxel tables against grid_sample, scipy and polynomials."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st
from torch.autograd import gradcheck

from ctm_plugin.cpu.lookup import SPARSE_FACTOR
from ctm_plugin.rays.grid import (
    Corners,
    VoxelGrid,
    add_smoothing,
    as_volume,
    cubic_shape,
    lookup,
    plane_shape,
    resample,
    voxel_size,
)

BOX = torch.tensor([[-1.0, 0.5, 2.0], [1.5, 1.75, 5.0]])
SHAPES = [(2, 2, 2), (4, 3, 5), (2, 7, 3)]
SHAPE = st.tuples(*[st.integers(2, 6)] * 3)
SEED = st.integers(0, 10**6)


def rand(*shape: int, seed: int = 0, dtype=torch.float32) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_box_around_cells(shape):
    """Half a voxel round the vertices that were chosen, and no further than the grid's box."""
    grid = VoxelGrid(BOX, shape)
    chosen = torch.zeros(grid.count, dtype=torch.bool)
    chosen[[1, grid.count // 2]] = True
    vertices, half = grid.vertices()[chosen], 0.5 * (BOX[1] - BOX[0]) / (torch.tensor(shape) - 1)
    expected = torch.stack([vertices.amin(0) - half, vertices.amax(0) + half]).clamp(*BOX)
    torch.testing.assert_close(grid.box_around(chosen), expected)
    assert (grid.box_around(~chosen & chosen).diff(dim=0) < 0).all()


def points_round(box: torch.Tensor, count: int, seed: int = 0, margin: float = 0.3) -> torch.Tensor:
    """Points in a box and around it."""
    return box[0] + (rand(count, 3, seed=seed) * (1 + 2 * margin) - margin) * (box[1] - box[0])


def vertices_by_hand(box: torch.Tensor, shape: tuple[int, int, int]) -> torch.Tensor:
    low, size = box[0].tolist(), (box[1] - box[0]).tolist()
    return torch.tensor(
        [
            [start + index * length / (n - 1) for start, index, length, n in zip(low, at, size, shape, strict=True)]
            for at in np.ndindex(shape)
        ]
    )


def grid_sample(table: torch.Tensor, shape: tuple[int, int, int], points: torch.Tensor) -> torch.Tensor:
    """``torch.nn.functional.grid_sample`` in the table's box, whose axes it wants in the order z, y, x."""
    unit = 2 * (points - BOX[0]) / (BOX[1] - BOX[0]) - 1
    volume = table.reshape(1, *shape, -1).permute(0, 4, 1, 2, 3)
    where = unit.flip(-1).to(table.dtype)[None, None, None]
    return F.grid_sample(volume, where, padding_mode="border", align_corners=True)[0, :, 0, 0].T


@pytest.mark.parametrize("shape", SHAPES)
def test_vertices(shape):
    grid = VoxelGrid(BOX, shape)
    torch.testing.assert_close(grid.vertices(), vertices_by_hand(BOX, shape))
    rows = torch.arange(grid.count).flip(0)
    assert grid.vertices_at(rows).equal(grid.vertices().flip(0))
    assert grid.count == len(grid.vertices()) == math.prod(shape)


@pytest.mark.parametrize("shape", SHAPES)
def test_table_as_volume(shape):
    table = rand(math.prod(shape), 2)
    volume = as_volume(table, shape)
    for row, at in enumerate(np.ndindex(shape)):
        assert torch.equal(volume[:, *at], table[row])


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("channels", [1, 5])
def test_lookup_is_grid_sample(shape, channels):
    table = rand(math.prod(shape), channels).requires_grad_()
    points = points_round(BOX, 200)
    found = lookup(table, VoxelGrid(BOX, shape).corners(points))
    expected = grid_sample(table, shape, points)
    torch.testing.assert_close(found, expected, atol=3e-6, rtol=0)
    grad = rand(*found.shape, seed=1) - 0.5
    (gradient,) = torch.autograd.grad(found, table, grad)
    torch.testing.assert_close(gradient, torch.autograd.grad(expected, table, grad)[0], atol=1e-5, rtol=0)


def test_lookup_gradient():
    corners = VoxelGrid(BOX, (3, 2, 4)).corners(points_round(BOX, 6))
    at = Corners(corners.rows, corners.weights.double())
    assert gradcheck(lambda table: lookup(table, at), rand(24, 2, dtype=torch.float64).requires_grad_())


@pytest.mark.parametrize("sparse", [False, True])
def test_lookup_of_no_points(sparse):
    table = rand(8, 2).requires_grad_()
    found = lookup(table, VoxelGrid(BOX, (2, 2, 2)).corners(torch.zeros(0, 3)), sparse)
    assert found.shape == (0, 2)
    found.sum().backward()
    assert table.grad.is_sparse == sparse
    assert (table.grad.to_dense() == 0).all()


@given(st.integers(1, 120), SEED)
def test_sparse_gradient(count, seed):
    """The same numbers to the bit: each row's contributions are added up in the same order, by one loop, unfused."""
    shape = (8, 7, 9)
    points = BOX[0] + (BOX[1] - BOX[0]) * rand(count, 3, seed=seed)
    at, grad = VoxelGrid(BOX, shape).corners(points), rand(count, 3, seed=seed + 1)
    tables = [rand(math.prod(shape), 3).requires_grad_() for _ in range(2)]
    for table, sparse in zip(tables, (False, True), strict=True):
        lookup(table, at, sparse).backward(grad)
    found = tables[1].grad
    assert torch.equal(found.to_dense(), tables[0].grad)
    assert found.is_sparse == (SPARSE_FACTOR * 8 * count < 3 * math.prod(shape))
    if found.is_sparse:
        assert torch.equal(found._indices()[0], at.rows.unique().long())


@given(SHAPE, SEED)
def test_corners_average_to_the_point(shape, seed):
    grid, points = VoxelGrid(BOX, shape), points_round(BOX, 50, seed, margin=2)
    corners = grid.corners(points)
    assert ((corners.rows >= 0) & (corners.rows < grid.count)).all()
    assert (corners.weights >= 0).all()
    torch.testing.assert_close(corners.weights.sum(1), torch.ones(50))
    around = grid.vertices()[corners.rows.long()]
    centre = (corners.weights[..., None] * around).sum(1)
    torch.testing.assert_close(centre, points.clamp(BOX[0], BOX[1]), atol=1e-5, rtol=0)
    # They are the corners of one voxel.
    spacing = (BOX[1] - BOX[0]) / (torch.tensor(shape) - 1)
    torch.testing.assert_close(around.amax(1) - around.amin(1), spacing.expand(50, 3), atol=1e-5, rtol=0)


@given(SHAPE, SEED)
def test_nearest(shape, seed):
    grid, points = VoxelGrid(BOX, shape), points_round(BOX, 50, seed)
    spacing = (BOX[1] - BOX[0]) / (torch.tensor(shape) - 1)
    distance = ((points[:, None] - grid.vertices()) / spacing).norm(dim=-1)
    row = grid.nearest(points)
    torch.testing.assert_close(distance.gather(1, row[:, None].long()).squeeze(1), distance.amin(1))
    index = grid.nearest_index(points)
    assert np.ravel_multi_index(index.T.tolist(), shape).tolist() == row.tolist()


@pytest.mark.parametrize("old", SHAPES)
@pytest.mark.parametrize("new", [(2, 2, 2), (5, 6, 7), (3, 2, 9)])
@pytest.mark.parametrize("channels", [1, 3])
def test_resample_is_a_lookup(old, new, channels):
    table = rand(math.prod(old), channels)
    expected = grid_sample(table, old, vertices_by_hand(BOX, new))
    resampled = resample(table, old, new)
    torch.testing.assert_close(resampled, expected, atol=3e-6, rtol=0)
    assert resampled.stride() == (channels, 1)


def test_resample_of_a_large_side_is_exact():
    values = rand(127)
    expected = np.interp(np.linspace(0, 1, 160), np.linspace(0, 1, 127), values.double())
    for axis in range(3):
        old, new = [2, 2, 2], [2, 2, 2]
        old[axis], new[axis] = 127, 160
        table = values.view([-1 if a == axis else 1 for a in range(3)]).expand(old).reshape(-1, 1)
        resampled = resample(table, tuple(old), tuple(new)).view(new).movedim(axis, -1)
        np.testing.assert_allclose(resampled, np.broadcast_to(expected, (2, 2, 160)), atol=3e-7)


@given(st.tuples(*[st.floats(0.5, 4)] * 3), st.integers(2, 100))
def test_cubic_shape(size, side):
    box = torch.tensor([[0.0, 0, 0], size]) + 0.7
    shape = cubic_shape(box, side**3)
    edge = (math.prod(size) / side**3) ** (1 / 3)
    assert voxel_size(box, side**3) == pytest.approx(edge, rel=1e-5)
    assert min(shape) >= 2
    for count, length in zip(shape, size, strict=True):
        # The most whole voxels that fit in, up to rounding, and two vertices at least.
        assert count == 2 or length / edge - 1 - 1e-3 <= count <= length / edge + 1e-3


@pytest.mark.parametrize("length", [0.7, 1.0, 3.0, 6.1])
@pytest.mark.parametrize("side", [2, 64, 100, 160])
def test_cubic_shape_of_a_cube(length, side):
    box = torch.tensor([[0.0, 0, 0], [length] * 3]) - length / 3
    assert cubic_shape(box, side**3) == (side,) * 3
    assert VoxelGrid(box, (side,) * 3).voxel == pytest.approx(length / side, rel=1e-5)


def total_variation(table, shape, weights):
    """As the formula has it, through autograd."""
    volume, total = table.view(*shape, -1), 0.0
    for axis, weight in enumerate(weights):
        difference = volume.diff(dim=axis)
        total = total + weight * F.huber_loss(difference, torch.zeros_like(difference), reduction="sum", delta=1.0)
    return total


@pytest.mark.parametrize("seen_only", [False, True])
@given(st.tuples(*[st.integers(2, 6)] * 3), st.integers(0, 10**6))
def test_smoothing_adds_the_gradient_of_total_variation(seen_only, shape, seed):
    random = torch.Generator().manual_seed(seed)
    table = torch.randn(math.prod(shape), 2, generator=random, requires_grad=True)
    seen = torch.rand(len(table), 1, generator=random) < 0.4
    grad = torch.randn(table.shape, generator=random) * seen
    weights = (0.3, 0.5, 2.0)
    (expected,) = torch.autograd.grad(total_variation(table, shape, weights), table)
    table.grad = grad.clone()
    add_smoothing(table, shape, weights, seen_only)
    torch.testing.assert_close(table.grad, grad + (expected * seen if seen_only else expected), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("voxels", "planes", "expected"), [(16 * 12 * 10, 10, (16, 12)), (8, 8, (2, 2)), (64 * 48 * 64, 64, (64, 48))]
)
def test_plane_shape(voxels, planes, expected):
    box = torch.tensor([[-2.0, -1.5, -1.0], [2.0, 1.5, 1.0]])
    assert plane_shape(box, voxels, planes) == (*expected, planes)
