"""DVGO's fields: a density grid and a feature grid, with post-activated density (Sun et al., CVPR 2022)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.profiler import record_function

from ctm_plugin.backbones.marching import DirectedMLP, Samples, marched, taken
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.encoding import embed
from ctm_plugin.rays.grid import (
    Corners,
    Shape,
    VoxelGrid,
    as_volume,
    dilate,
    lookup,
    may_meet,
    occupied_samples,
    resample,
)
from ctm_plugin.rays.sampling import intersect_box, sample_counts


class ViewMLP(DirectedMLP):
    """The colour network: the direction d is embedded as ``[d, sin(2^p d), cos(2^p d)]``, p = 0..frequencies-1."""

    def __init__(self, features: int, channels: int, width: int, depth: int, frequencies: int):
        super().__init__(features, 3 * (1 + 2 * frequencies), channels, width, depth)
        self.register_buffer("frequencies", 2.0 ** torch.arange(frequencies), persistent=False)

    def embed(self, directions: Tensor) -> Tensor:
        return embed(directions, self.frequencies)


class VoxelField(nn.Module):
    """Grids over a box: density and features, looked up at samples along rays.

    The density table holds raw values s; a sample has the optical depth ``softplus(s + shift) interval`` and
    ``alpha = 1 - exp(-optical depth)``. Interpolated first, activated after: one voxel can hold a sharp surface.

    A subclass gives ``stride``, ``interval``, ``vertex_shift`` and ``shift_at``, and where its space is not the
    world's, ``local`` and ``distances``.

    Args:
        box: ``[2, 3]``, in the field's space.
        shape: vertices along each side.
        features: channels of the feature table.
        near, far: the part of the field's rays that is looked at.
        behind: distance in the world at which light that nothing stops counts as stopped.
        threshold: samples with less alpha, or less weight, are skipped.
    """

    vertex_shift: Tensor | float
    """What is added to the raw density of the vertices, to be broadcast to ``[X, Y, Z]``."""

    def __init__(
        self, box: Tensor, shape: Shape, features: int, near: float, far: float, behind: float, threshold: float
    ):
        super().__init__()
        self.grid = VoxelGrid(box, shape)
        self.near, self.far, self.behind = near, far, behind
        self.threshold = threshold
        self.density = nn.Parameter(torch.zeros(self.grid.count, 1))
        self.features = nn.Parameter(torch.zeros(self.grid.count, features))
        self.register_buffer("occupancy", torch.ones(self.grid.count, dtype=torch.bool))

    @property
    def stride(self) -> float:
        """Distance between samples along the field's rays."""
        raise NotImplementedError

    @property
    def interval(self) -> float:
        """The stride in the units of density."""
        raise NotImplementedError

    def shift_at(self, points: Tensor) -> Tensor | float:
        """The same at points ``[M, 3]``."""
        raise NotImplementedError

    def local(self, rays: Rays) -> Rays:
        """The world's rays in the field's space."""
        return rays

    def distances(self, rays: Rays, t: Tensor, ray_index: Tensor) -> Tensor:
        """Distances in the world of samples ``t`` of the field's rays, ``[M]``; ``rays`` are the world's."""
        return t

    def optical_depth(self, raw: Tensor, shift: Tensor | float) -> Tensor:
        """Of samples ``[...]`` with raw density s: ``softplus(s + shift) interval``."""
        return F.softplus(raw + shift) * self.interval

    @torch.no_grad()
    def alpha(self) -> Tensor:
        """``[X, Y, Z]``: alpha of one sample at each vertex."""
        raw = as_volume(self.density, self.grid.shape)[0]
        return -torch.expm1(-self.optical_depth(raw, self.vertex_shift))

    def occupied_samples(self, rays: Rays, offset: Tensor | float) -> tuple[Tensor, ...]:
        """``t`` ``[M]``, rays ``[M]`` and points ``[M, 3]`` of all samples inside the box and not in free space.

        ``rays`` are the field's.
        """
        grid, stride = self.grid, self.stride
        enter, leave = intersect_box(rays, grid.box, self.near, self.far)
        counts = sample_counts(enter, leave, stride, offset)
        buffers = grid.box[0], grid.scale, grid.last, grid.offsets
        return occupied_samples(*rays, enter + offset * stride, counts, stride, self.occupancy, *buffers)

    def forward(
        self, rays: Rays, background: Tensor, offset: Tensor | float, mlp: ViewMLP | None, sparse: bool = False
    ) -> tuple[Tensor, Tensor, Samples]:
        """Render rays: latent ``[R, k]``, expected depth ``[R]``, and the samples behind them.

        Density is looked up only outside free space, features only where a sample's weight is above the threshold.
        Without an MLP the features are the latent, before a sigmoid. ``sparse`` gradients: see
        :func:`~ctm_plugin.rays.grid.lookup`.
        """
        with record_function("ctm/samples"):
            t, ray_index, points = self.occupied_samples(self.local(rays), offset)
        at = self.grid.corners(points)
        optical_depth = self.optical_depth(lookup(self.density, at, sparse).squeeze(1), self.shift_at(points))

        def shade(index: Tensor, ray_index: Tensor) -> Tensor:
            features = lookup(self.features, Corners(*taken(index, *at)), sparse)
            return features.sigmoid() if mlp is None else mlp(features, rays.directions, ray_index)

        return marched(
            optical_depth,
            t,
            ray_index,
            background,
            n_rays=len(rays.origins),
            behind=self.behind,
            threshold=self.threshold,
            distances=lambda t, ray_index: self.distances(rays, t, ray_index),
            shade=shade,
        )

    def place(self, points: Tensor) -> tuple[Tensor, Tensor | float]:
        """The world's points ``[M, 3]`` in the field's space, and how far ``t`` goes there for a unit of length."""
        return points, 1.0

    def query(self, points: Tensor, directions: Tensor, mlp: ViewMLP | None) -> tuple[Tensor, Tensor]:
        """Density ``[M]`` and latent ``[M, k]`` at points of the world, see :meth:`PosedBackbone.query`."""
        local, unit = self.place(points)
        low, high = self.grid.box
        there = ((local >= low) & (local <= high)).all(1) & self.occupancy[self.grid.nearest(local)]
        at = self.grid.corners(torch.minimum(torch.maximum(local, low), high))
        optical_depth = self.optical_depth(lookup(self.density, at).squeeze(1), self.shift_at(local))
        features = lookup(self.features, at)
        every = torch.arange(len(points), device=points.device)
        latent = features.sigmoid() if mlp is None else mlp(features, directions, every)
        return optical_depth / self.stride * unit * there, latent

    def dilated_alpha(self) -> Tensor:
        """``[V]``: the largest alpha of each vertex and its 26 neighbours, in the table's order."""
        return dilate(self.alpha()).flatten()

    @torch.no_grad()
    def update_occupancy(self) -> None:
        """Take vertices out whose neighbourhood has no alpha above the threshold."""
        self.occupancy &= self.dilated_alpha() > self.threshold

    @torch.no_grad()
    def resize(self, shape: Shape) -> None:
        """Resample both tables to other numbers of vertices; the parameters stay the same objects."""
        old, new = self.grid, VoxelGrid(self.grid.box.cpu(), shape).to(self.density.device)
        occupancy = self.occupancy[old.nearest(new.vertices())]
        for table in (self.density, self.features):
            table.data = resample(table.data, old.shape, shape)
            table.grad = None
        self.grid, self.occupancy = new, occupancy
        self.update_occupancy()

    @torch.no_grad()
    def hits(self, rays: Rays) -> Tensor:
        """``[R]`` boolean: whether a ray may meet an occupied vertex; errs to True."""
        rays = self.local(rays)
        enter, leave = intersect_box(rays, self.grid.box, self.near, self.far)
        return may_meet(rays, enter, leave, self.grid, self.occupancy)


class WorldField(VoxelField):
    """Cubic voxels over a box of the world.

    Args:
        box, shape, features, near, far, threshold: see :class:`VoxelField`.
        alpha_init: alpha of a fresh grid over one base voxel; the shift follows from it.
        step: distance between samples, in voxels.
        base_voxel: voxel size in scene units at which ``interval`` equals ``step``.
    """

    def __init__(
        self,
        box: Tensor,
        shape: Shape,
        features: int,
        *,
        near: float,
        far: float,
        threshold: float,
        alpha_init: float,
        step: float,
        base_voxel: float,
    ):
        super().__init__(box, shape, features, near, far, behind=far, threshold=threshold)
        self.vertex_shift = math.log(1 / (1 - alpha_init) - 1)
        self.step = step
        self.base_voxel = base_voxel

    @property
    def stride(self) -> float:
        return self.step * self.grid.voxel

    @property
    def interval(self) -> float:
        return self.stride / self.base_voxel

    def shift_at(self, points: Tensor) -> float:
        return self.vertex_shift
