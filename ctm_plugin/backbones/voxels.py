"""DVGO's field: a density grid and a feature grid, with post-activated density (Sun et al., CVPR 2022)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.grid import Lattice, Shape, as_volume, dilate, lookup, resample
from ctm_plugin.rays.sampling import intersect_box, march
from ctm_plugin.rays.volume import segment_sums, volume_weights


@dataclass
class Samples:
    """The packed samples that reached the colour of their rays.

    Attributes:
        latent: ``[M, k]`` in [0, 1].
        weights: ``[M]``.
        ray: ``[M]``.
        passed: ``[R]``, the transmittance behind the last sample of each ray.
    """

    latent: Tensor
    weights: Tensor
    ray: Tensor
    passed: Tensor


class ViewMLP(nn.Module):
    """Features and a view direction to a latent: ``depth`` linear layers with ReLU between them, then a sigmoid.

    The direction d is embedded as ``[d, sin(2^p d), cos(2^p d)]``, p = 0..frequencies-1.
    """

    def __init__(self, features: int, channels: int, width: int, depth: int, frequencies: int):
        super().__init__()
        self.register_buffer("frequencies", 2.0 ** torch.arange(frequencies)[:, None], persistent=False)
        sizes = [features + 3 * (1 + 2 * frequencies)] + [width] * (depth - 1)
        hidden = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.ReLU(inplace=True))]
        self.layers = nn.Sequential(*hidden, nn.Linear(sizes[-1], channels))
        nn.init.zeros_(self.layers[-1].bias)

    def forward(self, features: Tensor, directions: Tensor, ray: Tensor) -> Tensor:
        """``[M, features]``, ``[R, 3]``, ``[M]`` to ``[M, channels]`` in [0, 1]."""
        angles = (directions[:, None, :] * self.frequencies).flatten(1)
        embedded = torch.cat([directions, angles.sin(), angles.cos()], dim=-1)
        return self.layers(torch.cat([features, embedded[ray]], dim=-1)).float().sigmoid()


class VoxelField(nn.Module):
    """Grids over a box.

    The density table holds raw values s; a sample of length ``interval`` has optical depth
    ``softplus(s + shift) interval`` and ``alpha = 1 - exp(-optical depth)``, with ``shift`` such that s = 0 and
    interval 1 give ``alpha_init``. Interpolated first, activated after: one voxel can hold a sharp surface.

    Args:
        box: ``[2, 3]``.
        shape: vertices along each side.
        features: channels of the feature table.
        alpha_init: alpha of a fresh grid over one base voxel.
        threshold: samples with less alpha, or less weight, are skipped.
        step: distance between samples, in voxels.
        base_voxel: voxel size in scene units at which ``interval`` equals ``step``.
    """

    def __init__(
        self,
        box: Tensor,
        shape: Shape,
        features: int,
        *,
        alpha_init: float,
        threshold: float,
        step: float,
        base_voxel: float,
    ):
        super().__init__()
        self.lattice = Lattice(box, shape)
        self.shift = math.log(1 / (1 - alpha_init) - 1)
        self.threshold = threshold
        self.step = step
        self.base_voxel = base_voxel
        self.density = nn.Parameter(torch.zeros(self.lattice.count, 1))
        self.features = nn.Parameter(torch.zeros(self.lattice.count, features))
        self.register_buffer("occupancy", torch.ones(self.lattice.count, dtype=torch.bool))

    def optical_depth(self, raw: Tensor) -> Tensor:
        """Of a sample with raw density s: ``softplus(s + shift) interval``."""
        return F.softplus(raw + self.shift) * (self.step * self.lattice.voxel / self.base_voxel)

    @torch.no_grad()
    def alpha(self) -> Tensor:
        """``[X, Y, Z]``: alpha of one sample at each vertex."""
        return -torch.expm1(-self.optical_depth(as_volume(self.density, self.lattice.shape)[0]))

    def occupied_samples(self, rays: Rays, near: float, far: float, offset: Tensor | float) -> tuple[Tensor, ...]:
        """Distances ``[M]``, rays ``[M]`` and points ``[M, 3]`` of all samples inside the box and not in free space."""
        enter, leave = intersect_box(rays, self.lattice.box, near, far)
        t, ray = march(enter, leave, self.step * self.lattice.voxel, offset)
        points = torch.addcmul(rays.origins[ray], rays.directions[ray], t[:, None])
        keep = self.occupancy[self.lattice.nearest(points)].nonzero().squeeze(1)
        return t[keep], ray[keep], points[keep]

    def forward(
        self, rays: Rays, background: Tensor, near: float, far: float, offset: Tensor | float, mlp: ViewMLP | None
    ) -> tuple[Tensor, Tensor, Samples]:
        """Render rays: latent ``[R, k]``, expected depth ``[R]``, and the samples behind them.

        Density is looked up outside free space alone, features only where a sample's weight is above the threshold.
        Without an MLP the features are the latent, before a sigmoid.
        """
        count = len(rays.origins)
        t, ray, points = self.occupied_samples(rays, near, far, offset)
        at = self.lattice.corners(points)
        depth = self.optical_depth(lookup(self.density, at).squeeze(1))

        keep = (depth.detach() > -math.log1p(-self.threshold)).nonzero().squeeze(1)
        depth, t, ray, at = depth[keep], t[keep], ray[keep], at[keep]
        weights, passed = volume_weights(depth, ray, count)
        with torch.no_grad():
            expected = segment_sums(weights * t, ray, count) + passed * far

        keep = (weights.detach() > self.threshold).nonzero().squeeze(1)
        weights, ray = weights[keep], ray[keep]
        features = lookup(self.features, at[keep])
        latent = features.sigmoid() if mlp is None else mlp(features, rays.directions, ray)
        marched = segment_sums(weights[:, None] * latent, ray, count) + passed[:, None] * background
        return marched, expected, Samples(latent, weights, ray, passed)

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
        old, new = self.lattice, Lattice(self.lattice.box.cpu(), shape).to(self.density.device)
        occupancy = self.occupancy[old.nearest(new.vertices())]
        for table in (self.density, self.features):
            table.data = resample(table.data, old.shape, shape)
            table.grad = None
        self.lattice, self.occupancy = new, occupancy
        self.update_occupancy()

    @torch.no_grad()
    def hits(self, rays: Rays, near: float, far: float) -> Tensor:
        """``[R]`` boolean: whether a ray may meet an occupied vertex. Marched over blocks of voxels; errs to True."""
        block = 4
        volume = self.occupancy.reshape(1, *self.lattice.shape).float()
        # Dilated by one block: a sample stands for all points behind it, up to the next one, less than one block away
        # (of the shortest side, and a hundredth less for rounding). The first sample is where the ray enters.
        blocks = dilate(F.max_pool3d(volume, block, ceil_mode=True)[0])
        enter, leave = intersect_box(rays, self.lattice.box, near, far)
        t, ray = march(enter, leave, 0.99 * block / self.lattice.scale.max().item(), 0.0)
        points = torch.addcmul(rays.origins[ray], rays.directions[ray], t[:, None])
        x, y, z = (self.lattice.nearest_index(points) // block).unbind(-1)
        return segment_sums(blocks[x, y, z], ray, len(rays.origins)) > 0
