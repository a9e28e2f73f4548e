"""NGP's features: a multiresolution hash grid and two small networks (Müller et al., SIGGRAPH 2022)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from ctm_plugin.backbones.networks import DensityMLP, HarmonicMLP
from ctm_plugin.backbones.occupied import OccupiedField, Shade, taken
from ctm_plugin.backbones.spaces import Box
from ctm_plugin.draws import Draws
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.grid import VoxelGrid, cubic_shape
from ctm_plugin.rays.hash_density import MAX_LOG_DENSITY, log_density, visible_samples
from ctm_plugin.rays.hash_grid import HashGrid
from ctm_plugin.rays.occupancy import dilate, may_meet

GEOMETRY_FEATURES = 16
"""Outputs of the density network that the colour network gets; the first is the density's logarithm."""
OCCUPANCY_DECAY = 0.95
"""Factor on a cell's stored alpha at each update of the occupancy (instant-ngp)."""
CELL_CHUNK = 1 << 16
"""Cells whose density is evaluated at once."""
RAY_CHUNK = 1 << 12
"""Rays that are sampled at once."""


class HashField(OccupiedField):
    """Density and colour out of hashed features.

    Over one measure of the space a sample has the optical depth ``exp(r)``, r the density network's first output. The
    occupancy grid holds the largest alpha that a sample of a cell had lately.

    Args:
        space: the space that the field fills.
        hash_grid: grid of the features.
        cells: number of cells of the occupancy grid, about.
        channels: number k of latent channels.
        width: units of the networks' hidden layers.
        degrees: degrees of the spherical harmonics of view directions.
        alpha_thre: see :class:`OccupiedField`.
        free_below: alpha below which cells are free, or the mean alpha of all cells where that is less.
    """

    def __init__(
        self, space: Box, hash_grid: HashGrid, *, cells: int, channels: int, width: int, degrees: int,
        alpha_thre: float, free_below: float,
    ):  # fmt: skip
        super().__init__(space, VoxelGrid(space.aabb, cubic_shape(space.aabb, cells)), alpha_thre)
        self.hash_grid, self.free_below = hash_grid, free_below
        self.density = DensityMLP(len(hash_grid.sides) * hash_grid.table.shape[1], width, GEOMETRY_FEATURES)
        self.color = HarmonicMLP(GEOMETRY_FEATURES, channels, width, 3, degrees)
        self.register_buffer("alpha", torch.zeros(self.grid.count))
        self.register_buffer("allowed", self.occupancy.clone())
        # The occupancy goes on changing: a resumed run draws its rays by what was found when cells last settled.
        self.register_buffer("met", self.occupancy.clone())

    def evaluate(self, points: Tensor, features: Tensor | None = None) -> tuple[Tensor, Shade]:
        out = self.density(self.hash_grid(self.space.unit(points), features))

        def shade(index: Tensor, directions: Tensor, ray_index: Tensor) -> Tensor:
            return self.color(*taken(index, out), directions, ray_index)

        return out[:, 0].clamp_max(MAX_LOG_DENSITY).exp(), shade

    def log_density(self, points: Tensor) -> Tensor:
        """Logarithm of the density, ``[M]``, at points ``[M, 3]`` of the space; without gradients."""
        return log_density(*self._looked_up(), self.space.unit(points))

    def reached(self, t: Tensor, ray_index: Tensor, points: Tensor, n_rays: int) -> tuple[Tensor, ...]:
        """Keep the N samples with alpha that light reaches, and give their features, ``[N, F]``, too."""
        lengths = self.space.lengths(t, points)
        lengths = lengths if isinstance(lengths, Tensor) else t.new_full((1,), lengths)
        unit = self.space.unit(points)
        index, features = visible_samples(*self._looked_up(), unit, lengths, ray_index, n_rays, self.alpha_thre)
        return *taken(index, t, ray_index, points), features

    def _looked_up(self) -> tuple[Tensor, Tensor, Tensor, nn.Linear, nn.Linear]:
        grid, layers = self.hash_grid, self.density.layers
        return grid.table, grid.sides, grid.starts, layers[0], layers[2]

    @torch.no_grad()
    def update_occupancy(self, draws: Draws, share: float) -> None:
        """Update the cells' alpha at random points in a ``share`` of them, and in as many occupied ones; 1: in all.

        Every cell's stored alpha decays; the larger of it and the new one is kept.
        """
        count = len(self.alpha)
        if share < 1:
            some, known = max(1, int(share * count)), self.occupancy.nonzero().squeeze(1)
            cells = [draws.integers(count, some)]
            cells += [known[draws.integers(len(known), some)]] if len(known) else []
            cells = torch.cat(cells)
        else:
            cells = torch.arange(count, device=self.alpha.device)
        low, high = self.space.aabb
        within = (draws.uniform(len(cells), 3) - 0.5) / self.grid.scale
        points = torch.minimum(torch.maximum(self.grid.vertices_at(cells) + within, low), high)
        self.alpha *= OCCUPANCY_DECAY
        longest = self.space.stride / self.space.side
        for index, part in zip(cells.split(CELL_CHUNK), points.split(CELL_CHUNK), strict=True):
            seen = -torch.expm1(-self.log_density(part).clamp_max(MAX_LOG_DENSITY).exp() * longest)
            self.alpha.scatter_reduce_(0, index, seen, "amax")
        self.occupy(self.alpha > self.alpha.mean().clamp_max(self.free_below))

    @torch.no_grad()
    def free_permanently(self, below: float, rays: Rays, hull: Callable[[Tensor], Tensor]) -> None:
        """Free cells permanently if they and their neighbours have less alpha than ``below``.

        Cells on world ``rays`` that meet no cell of more alpha stay, where ``hull`` of points ``[M, 3]`` is true.
        """
        filled = self.alpha >= below
        lost = self.on_those_that_miss(rays, self.allowed & filled)
        rows = lost.nonzero().squeeze(1)
        lost[rows] = hull(self.grid.vertices_at(rows))
        self.allowed &= (dilate(filled.float().view(self.grid.shape)).flatten() > 0) | lost
        self.occupy(self.occupancy)
        self.met = self.occupancy | (self.allowed & lost)

    def on_those_that_miss(self, rays: Rays, cells: Tensor) -> Tensor:
        """``[V]`` boolean: cells, dilated by one, on those rays of the world that meet none of ``cells`` ``[V]``."""
        hit, everywhere = torch.zeros_like(cells), torch.ones_like(cells)
        for part in zip(*(each.split(RAY_CHUNK) for each in self.space.local(rays)), strict=True):
            misses = torch.ones(len(part[0]), dtype=torch.bool, device=cells.device)
            misses[self.samples(Rays(*part), 0.5, cells)[1].long()] = False
            points = self.samples(Rays(*(each[misses] for each in part)), 0.5, everywhere)[2]
            hit[self.grid.nearest(points).long()] = True
        return dilate(hit.float().view(self.grid.shape)).flatten() > 0

    @torch.no_grad()
    def hits(self, rays: Rays) -> Tensor:
        """Tell which rays, ``[R]``, may meet cells that were occupied when cells last settled."""
        rays = self.space.local(rays)
        ends = self.space.ends(rays, self.grid.box_around(self.met))
        return may_meet(rays, *ends, self.grid, self.met, block=2)  # cells are few, and large

    @torch.no_grad()
    def occupy(self, cells: Tensor) -> None:
        """Mark these cells ``[V]`` (boolean) as occupied and all others as free."""
        self.occupancy.copy_(cells & self.allowed)
        self.around.copy_(self.grid.box_around(self.occupancy))
