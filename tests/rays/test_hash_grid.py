"""Multiresolution hash grids: resolutions, a hash in big integers, what trilinear lookup reproduces, gradients."""

import itertools
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin import door
from ctm_plugin.rays.hash_grid import HashGrid, encoded, hashed_corners, resolutions, spread

SEED = st.integers(0, 10**6)


def rand(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def test_resolutions():
    assert resolutions(1, 16, 512) == [16]
    assert resolutions(6, 16, 512) == [16, 32, 64, 128, 256, 512]
    assert resolutions(16, 16, 2048)[:3] == [16, 22, 30]
    assert resolutions(16, 16, 2048)[-1] == 2048


@given(SEED, st.integers(1, 600), st.integers(4, 20))
def test_rows_are_the_paper_s(seed, side, log2_entries):
    """One each where they suffice; else the hash, of Python's integers as 32-bit words."""
    points, entries = rand(9, 3, seed=seed), 1 << log2_entries
    vertices, first = (side + 1) ** 3, 8  # a level before has one cell
    starts = torch.tensor([0, first, first + min(entries, vertices)])
    rows, weights = hashed_corners(points, torch.tensor([1, side]), starts)
    for point, found, shares in zip(points.double() * side, rows[:, 1] - first, weights[:, 1], strict=True):
        below = [min(math.floor(float(torch.tensor(x).float())), side - 1) for x in point.tolist()]
        expected, total = {}, 0.0
        for step in itertools.product((0, 1), repeat=3):
            x, y, z = (low + up for low, up in zip(below, step, strict=True))
            if vertices <= entries:
                row = x + (side + 1) * (y + (side + 1) * z)
            else:
                row = ((x % 2**32) ^ (y * 2654435761 % 2**32) ^ (z * 805459861 % 2**32)) % entries
            share = math.prod(
                (p - low if up else 1 - (p - low)) for p, low, up in zip(point.tolist(), below, step, strict=True)
            )
            expected[row] = expected.get(row, 0.0) + share
            total += share
        assert total == pytest.approx(1)
        by_row: dict[int, float] = {}
        for row, share in zip(found.tolist(), shares.tolist(), strict=True):
            by_row[row] = by_row.get(row, 0.0) + share
        assert by_row.keys() == expected.keys()
        for row, share in by_row.items():
            assert share == pytest.approx(expected[row], abs=1e-3)


@pytest.mark.parametrize("loop", [True, False])
def test_a_linear_field_is_reproduced_by_levels_with_a_row_a_vertex(loop):
    grid = HashGrid(3, 2, 1 << 15, 4, 12)
    with torch.no_grad():
        for side, start in zip(grid.sides.tolist(), grid.starts.tolist(), strict=False):
            axis = torch.arange(side + 1) / side
            z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
            values = torch.stack([1 + 2 * x - 3 * y + z, x + 0.5 * z], dim=-1).flatten(0, 2)
            grid.table[start : start + len(values)] = values
    points = rand(200, 3)
    x, y, z = points.T
    expected = torch.stack([1 + 2 * x - 3 * y + z, x + 0.5 * z], dim=1).repeat(1, 3)
    found = (encoded if loop else encoded.reference)(grid.table.detach(), points, grid.sides, grid.starts)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


def test_faces_and_what_lies_outside():
    """A cube's far corner is its last vertex; points outside are taken to the nearest face."""
    grid = HashGrid(2, 2, 1 << 10, 4, 40)
    for function in (encoded, encoded.reference):
        corner = function(grid.table.detach(), torch.ones(1, 3), grid.sides, grid.starts)
        torch.testing.assert_close(corner[0, :2], grid.table.detach()[124])
        outside = torch.tensor([[1.5, -0.2, 0.4], [1.0, 0.0, 0.4]])
        out, at = function(grid.table.detach(), outside, grid.sides, grid.starts)
        assert torch.equal(out, at)


@pytest.mark.parametrize("count", [0, 1, 7, 20])
def test_points_in_blocks_are_those_in_one(count, monkeypatch):
    grid, points, grad = HashGrid(3, 2, 1 << 8, 3, 20), rand(count, 3), rand(count, 6, seed=1)
    given = points, grid.sides, grid.starts
    whole = encoded.reference(grid.table.detach(), *given), spread.reference(grad, *given, grid.table.shape)
    monkeypatch.setattr("ctm_plugin.rays.hash_grid.POINT_BLOCK", 7)
    blocks = encoded.reference(grid.table.detach(), *given), spread.reference(grad, *given, grid.table.shape)
    torch.testing.assert_close(blocks, whole)


@given(SEED, st.integers(1, 6), st.integers(4, 14), st.integers(0, 80))
def test_loops_are_the_plain_versions(seed, levels, log2_entries, count):
    grid = HashGrid(levels, 2, 1 << log2_entries, 3, 90)
    table, points = rand(*grid.table.shape, seed=seed) - 0.5, 1.2 * rand(count, 3, seed=seed + 1) - 0.1
    given = table, points, grid.sides, grid.starts
    torch.testing.assert_close(encoded(*given), encoded.reference(*given), atol=2e-5, rtol=1e-5)
    grad = rand(count, 2 * levels, seed=seed + 2) - 0.5
    given = grad, points, grid.sides, grid.starts, grid.table.shape
    torch.testing.assert_close(spread(*given), spread.reference(*given), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("features", [1, 2, 4])
def test_gradients(features, monkeypatch):
    """Of float64, by differences; no number of features but two has a loop."""
    grid = HashGrid(3, features, 32, 2, 9).double()
    assert torch.autograd.gradcheck(lambda table: _encode(grid, table), grid.table.data.clone().requires_grad_())
    monkeypatch.setattr(door, "may_run", lambda _: pytest.fail("asked") if features != 2 else False)
    assert grid.float()(rand(5, 3)).shape == (5, 3 * features)


def _encode(grid: HashGrid, table: torch.Tensor) -> torch.Tensor:
    return torch.func.functional_call(grid, {"table": table}, (rand(5, 3).double(),))
