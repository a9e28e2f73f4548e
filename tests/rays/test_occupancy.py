"""Which rays may meet an occupied cell, and the neighbourhood of cells."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.ndimage import maximum_filter

from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.grid import VoxelGrid
from ctm_plugin.rays.occupancy import dilate, may_meet, occupied_samples
from ctm_plugin.rays.sampling import intersect_box, sample_counts

NEAR, FAR = 0.5, 6.0


def origins_of(count: int, rng: torch.Generator) -> torch.Tensor:
    return 3 * F.normalize(torch.randn(count, 3, generator=rng), dim=1)


@pytest.mark.parametrize("shape", [(2, 2, 2), (4, 3, 5), (2, 7, 3)])
def test_dilate(shape):
    volume = torch.rand(*shape) - 2
    expected = maximum_filter(volume.numpy(), size=3, mode="constant", cval=-np.inf)
    np.testing.assert_array_equal(dilate(volume), expected)


@given(
    st.tuples(*[st.integers(2, 30)] * 3), st.tuples(*[st.floats(0.3, 3)] * 3), st.integers(1, 3), st.integers(0, 10**6)
)
@example((2, 2, 30), (1.0, 1.0, 1.0), 1, 0)
@example((13, 13, 13), (1.0, 1.0, 1.0), 2, 0)
def test_no_ray_is_missed(shape, size, solid, seed):
    """Rays aimed at a few solid vertices, many of them on a face, of boxes whose voxels are no cubes."""
    rng, count = torch.Generator().manual_seed(seed), 1000
    box = torch.tensor([[0.0, 0, 0], size]) - 0.5
    grid, last = VoxelGrid(box, shape), torch.tensor(shape) - 1
    index = ((1.5 * torch.rand(solid, 3, generator=rng) - 0.25) * last).round().clamp(torch.zeros(3), last).long()
    occupancy = torch.zeros(shape, dtype=torch.bool)
    occupancy[tuple(index.T)] = True
    target = index[torch.arange(count) % solid] + torch.rand(count, 3, generator=rng) - 0.5
    target = box[0] + target.clamp(torch.zeros(3), last) * (box[1] - box[0]) / last
    origins, offset, step = origins_of(count, rng), torch.rand(count, generator=rng), 0.5 * grid.voxel
    rays = Rays(origins, F.normalize(target - origins, dim=1))
    enter, leave = intersect_box(rays, box, NEAR, FAR)
    counts, buffers = sample_counts(enter, leave, step, offset), (grid.aabb[0], grid.scale, grid.last, grid.offsets)
    found = torch.zeros(count, dtype=torch.bool)
    found[occupied_samples(*rays, enter + offset * step, counts, step, occupancy.flatten(), *buffers)[1]] = True
    assert not (found & ~may_meet(rays, enter, leave, grid, occupancy.flatten())).any()


def test_free_rays_are_left_out():
    box, rng = torch.tensor([[-1.0, -0.5, -2.0], [1.0, 1.25, 0.5]]), torch.Generator().manual_seed(0)
    grid, origins = VoxelGrid(box, (40, 40, 40)), origins_of(2000, rng)
    aims = box[0] + (1.4 * torch.rand(2000, 3, generator=rng) - 0.2) * (box[1] - box[0])
    rays = Rays(origins, F.normalize(aims - origins, dim=1))
    ends = intersect_box(rays, box, NEAR, FAR)
    occupancy = torch.zeros(grid.count, dtype=torch.bool)
    assert not may_meet(rays, *ends, grid, occupancy).any()
    occupancy[(20 * 40 + 21) * 40 + 23] = True
    # The vertex stands in the block of vertices 20 to 23 along each side; with those round it 16 to 27.
    round_it = box[0] + torch.tensor([[15.5], [27.5]]) * (box[1] - box[0]) / 39
    enter, leave = intersect_box(rays, round_it, NEAR, FAR)
    hits = may_meet(rays, *ends, grid, occupancy)
    assert not hits[leave <= enter].any()
    assert hits[leave > enter + 4 * (box[1] - box[0]).norm() / 39].all()
    assert 0.05 < hits.float().mean() < 0.5
