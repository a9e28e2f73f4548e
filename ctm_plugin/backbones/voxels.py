"""DVGO's features: a density grid and a feature grid, with post-activated density (Sun et al., CVPR 2022)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ctm_plugin.backbones.networks import ViewMLP
from ctm_plugin.backbones.occupied import OccupiedField, Shade, taken
from ctm_plugin.backbones.spaces import Box
from ctm_plugin.rays.grid import Corners, Shape, VoxelGrid, as_volume, lookup, resample
from ctm_plugin.rays.occupancy import dilate


class VoxelField(OccupiedField):
    """Grids over a space's box: density and features, looked up at samples along rays.

    The density table holds raw values s; over one measure of the space a sample has the optical depth
    ``softplus(s + shift)``. Interpolated first, activated after: one voxel can hold a sharp surface.

    Args:
        space: the space whose box the grids fill.
        shape: vertices along each side.
        features: channels of the feature table.
        color: network from features to latents.
        direct: the features are the latents before a sigmoid, and ``color`` is kept but not used.
        alpha_thre: see :class:`OccupiedField`.
        step: distance between samples, in voxels or planes.
        shift: shift of the raw density: one number, or one a plane, ``[Z]``, interpolated between planes.

    Attributes:
        sparse: whether the tables get sparse gradients, see :func:`~ctm_plugin.rays.grid.lookup`.
    """

    def __init__(
        self, space: Box, shape: Shape, features: int, color: ViewMLP, *, direct: bool = False, alpha_thre: float,
        step: float, shift: Tensor | float,
    ):  # fmt: skip
        super().__init__(space, VoxelGrid(space.aabb, shape), alpha_thre)
        self.color, self.direct, self.step, self.sparse = color, direct, step, False
        space.divide(step * space.spacing(shape))
        self.density = nn.Parameter(torch.zeros(self.grid.count, 1))
        self.features = nn.Parameter(torch.zeros(self.grid.count, features))
        if isinstance(shift, Tensor):
            self.register_buffer("vertex_shift", shift.float(), persistent=False)
        else:
            self.vertex_shift = shift

    def shift_at(self, points: Tensor) -> Tensor | float:
        """Shift of the raw density at points ``[M, 3]``."""
        if not isinstance(self.vertex_shift, Tensor):
            return self.vertex_shift
        last = len(self.vertex_shift) - 1
        position = ((points[:, 2] - self.grid.aabb[0, 2]) * self.grid.scale[2]).clamp(0, last)
        below = position.floor().clamp_max(last - 1)
        index = below.long()
        return torch.lerp(self.vertex_shift[index], self.vertex_shift[index + 1], position - below)

    def evaluate(self, points: Tensor) -> tuple[Tensor, Shade]:
        at = self.grid.corners(points)
        density = F.softplus(lookup(self.density, at, self.sparse).squeeze(1) + self.shift_at(points))

        def shade(index: Tensor, directions: Tensor, ray_index: Tensor) -> Tensor:
            features = lookup(self.features, Corners(*taken(index, *at)), self.sparse)
            return features.sigmoid() if self.direct else self.color(features, directions, ray_index)

        return density, shade

    @torch.no_grad()
    def alpha(self) -> Tensor:
        """Alpha of one sample at each vertex, ``[X, Y, Z]``."""
        raw = as_volume(self.density, self.grid.shape)[0]
        return -torch.expm1(-F.softplus(raw + self.vertex_shift) * (self.space.stride / self.space.measure))

    def dilated_alpha(self) -> Tensor:
        """Largest alpha of each vertex and its 26 neighbours, ``[V]``, in the table's order."""
        return dilate(self.alpha()).flatten()

    @torch.no_grad()
    def update_occupancy(self) -> None:
        """Free vertices whose neighbourhood has no alpha above ``alpha_thre``."""
        self.occupancy &= self.dilated_alpha() > self.alpha_thre

    @torch.no_grad()
    def resize(self, shape: Shape) -> None:
        """Resample both tables to other numbers of vertices; the parameters stay the same objects."""
        old, new = self.grid, VoxelGrid(self.grid.aabb.cpu(), shape).to(self.density.device)
        occupancy = self.occupancy[old.nearest(new.vertices())]
        for table in (self.density, self.features):
            table.data = resample(table.data, old.shape, shape)
            table.grad = None
        self.grid, self.occupancy = new, occupancy
        self.space.divide(self.step * self.space.spacing(shape))
        self.update_occupancy()
