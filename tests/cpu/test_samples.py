"""Samples outside free space, and the voxels round them, against the versions in torch, which GPUs run."""

import itertools
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin import door
from ctm_plugin.backbones.occupied import OccupiedField
from ctm_plugin.backbones.spaces import Box
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.grid import VoxelGrid, corners

BOX = torch.tensor([[-1.0, -0.8, -0.7], [1.0, 1.1, 0.9]])
SEED = st.integers(0, 10**6)


def field_of(shape: tuple[int, int, int], rng: torch.Generator) -> OccupiedField:
    field = OccupiedField(Box(BOX, 0.5, 6.0, 6.0), VoxelGrid(BOX, shape), 1e-4)
    field.space.divide(0.5 * field.grid.voxel)
    share = torch.rand(1, generator=rng) ** 3  # of few there are blocks without any
    field.occupancy[:] = torch.rand(field.occupancy.shape, generator=rng) < share
    return field


def rays_at(count: int, rng: torch.Generator) -> Rays:
    """Towards the box, and past it."""
    origins = 4 * torch.nn.functional.normalize(torch.randn(count, 3, generator=rng), dim=1)
    return Rays(origins, torch.nn.functional.normalize(3 * torch.rand(count, 3, generator=rng) - 1.5 - origins, dim=1))


def by_torch(field: OccupiedField, rays: Rays, offset: torch.Tensor | float) -> tuple[torch.Tensor, ...]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(door, "may_run", lambda _: False)
        return field.samples(rays, offset)


@given(st.tuples(*[st.integers(2, 20)] * 3), st.integers(0, 60), st.booleans(), SEED)
def test_occupied_samples(shape, count, jittered, seed):
    """Distances to the bit: one product and one sum, each rounded, as these loops let LLVM fuse nothing."""
    rng = torch.Generator().manual_seed(seed)
    field, rays = field_of(shape, rng), rays_at(count, rng)
    offset = torch.rand(count, generator=rng) if jittered else 0.5
    scattered = field.occupancy.clone()
    field.occupancy[:] = True
    every = field.samples(rays, offset)
    plain = by_torch(field, rays, offset)
    assert torch.equal(every[0], plain[0])
    assert torch.equal(every[1], plain[1])
    torch.testing.assert_close(every[2], plain[2], atol=1e-6, rtol=1e-6)
    field.occupancy[:] = scattered
    kept = scattered[field.grid.nearest(every[2])]
    for found, expected in zip(field.samples(rays, offset), every, strict=True):
        assert torch.equal(found, expected[kept])
    t, _, points = field.samples(rays, offset)
    assert points.stride() == (1, len(t)) or not len(t)
    # torch's points are rounded once less: those in the middle between two vertices may go to either.
    position = (plain[2] - BOX[0]) * field.grid.scale
    middle = (position.frac() - 0.5).abs().amin(1)
    assert abs(len(t) - len(by_torch(field, rays, offset)[0])) <= (middle < 1e-4).sum()


def test_rays_that_are_no_numbers():
    rng = torch.Generator().manual_seed(0)
    field, rays = field_of((4, 4, 4), rng), rays_at(3, rng)
    rays.origins[1] = torch.nan
    with pytest.raises(ValueError, match="is it a number"):
        field.samples(rays, 0.5)


@given(st.tuples(*[st.integers(2, 20)] * 3), st.integers(0, 200), SEED)
def test_corners(shape, count, seed):
    """To the bit: the same products and differences in the same order, each rounded."""
    rng = torch.Generator().manual_seed(seed)
    grid = field_of(shape, rng).grid
    points = 1.3 * (2 * torch.rand(count, 3, generator=rng) - 1)
    buffers = grid.aabb[0], grid.scale, grid.last, grid.offsets
    for found, expected in zip(grid.corners(points), corners.reference(points, *buffers), strict=True):
        assert torch.equal(found, expected)
        assert found.dtype == expected.dtype


def test_points_that_are_no_numbers_have_corners_in_the_grid():
    grid = field_of((5, 6, 7), torch.Generator().manual_seed(0)).grid
    for numbers in itertools.product([math.nan, math.inf, -math.inf, 0.2], repeat=3):
        rows, weights = grid.corners(torch.tensor([numbers]))
        assert 0 <= rows.min() <= rows.max() < grid.count
        assert weights.isnan().any() == (math.nan in numbers)
