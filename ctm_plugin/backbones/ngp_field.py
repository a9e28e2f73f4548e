"""A multiresolution hash grid and two small networks (Müller et al., SIGGRAPH 2022)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.profiler import record_function

from ctm_plugin.backbones.marching import DirectedMLP, Samples, marched, taken
from ctm_plugin.backbones.spaces import BoxSpace
from ctm_plugin.cpu.blocked_mlp import blocked_mlp
from ctm_plugin.draws import Draws
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.grid import VoxelGrid, cubic_shape, dilate, may_meet, occupied_samples
from ctm_plugin.rays.hash_density import DENSEST, lit, log_density
from ctm_plugin.rays.hash_grid import HashGrid
from ctm_plugin.rays.sampling import sample_counts
from ctm_plugin.rays.spherical_harmonics import harmonics

GEOMETRY = 16
"""Numbers that the density network hands to the colour network, the density's logarithm first."""
DECAY = 0.95
"""What an update of the occupancy leaves of what was known of a cell."""
CHUNK = 1 << 16
"""Cells that are looked at in one go."""
RAYS = 1 << 12
"""Rays that samples are looked for on in one go."""


class HarmonicMLP(DirectedMLP):
    """The colour network, of directions as spherical harmonics of ``degrees`` degrees."""

    def __init__(self, features: int, channels: int, width: int, depth: int, degrees: int):
        super().__init__(features, degrees**2, channels, width, depth)
        self.degrees = degrees

    def embed(self, directions: Tensor) -> Tensor:
        """``[R, 3]`` to ``[R, degrees^2]``."""
        return harmonics(directions, self.degrees)


class AsItIs:
    """The entry of a table that a network takes as it is, see :class:`ctm_plugin.cpu.blocked_mlp.Entry`."""

    def enter(self, table: Tensor, at: slice, out: Tensor) -> None:
        """Write the rows, ``[n, D]``."""
        out.copy_(table)

    def leave(self, grad: Tensor, entered: Tensor) -> Tensor:
        """Keep it, ``[n, D]``."""
        return grad


class DensityMLP(nn.Module):
    """Features ``[M, F]`` to ``[M, 16]``: one hidden layer with a ReLU, the last one linear."""

    def __init__(self, features: int, width: int):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(features, width), nn.ReLU(), nn.Linear(width, GEOMETRY))
        nn.init.zeros_(self.layers[-1].bias)

    def forward(self, features: Tensor) -> Tensor:
        """``[M, features]`` to ``[M, 16]``."""
        if features.device.type != "cpu":
            return self.layers(features).float()
        weights, biases = zip(*((layer.weight, layer.bias) for layer in self.layers[::2]), strict=True)
        return blocked_mlp(features, AsItIs(), weights, biases, sigmoid=False)


class NGPField(nn.Module):
    """Density and colour out of hashed features, looked up where samples along rays are not in free space.

    A sample has the optical depth ``exp(r) l``, r the density network's first output, l its length in sides of the
    space's box. Free space is what an occupancy grid says: it holds the largest alpha that a sample of a cell had
    lately.

    Args:
        space: where it lives.
        hash_grid: of features.
        cells: of the occupancy, about.
        channels: of the latent.
        width: of the networks' hidden layers.
        degrees: of the directions' harmonics.
        threshold: samples with less alpha, or less weight, are skipped.
        free_below: cells with less alpha are free; the mean of all is, where that is less.
    """

    def __init__(
        self,
        space: BoxSpace,
        hash_grid: HashGrid,
        *,
        cells: int,
        channels: int,
        width: int,
        degrees: int,
        threshold: float,
        free_below: float,
    ):
        super().__init__()
        self.space, self.hash_grid = space, hash_grid
        self.density = DensityMLP(len(hash_grid.sides) * hash_grid.table.shape[1], width)
        self.color = HarmonicMLP(GEOMETRY, channels, width, 3, degrees)
        self.threshold, self.free_below = threshold, free_below
        self.grid = VoxelGrid(space.box, cubic_shape(space.box, cells))
        self.register_buffer("alpha", torch.zeros(self.grid.count))
        self.register_buffer("occupancy", torch.ones(self.grid.count, dtype=torch.bool))
        self.register_buffer("allowed", self.occupancy.clone())
        # The occupancy goes on changing: a resumed run draws its rays by what was found when cells last settled.
        self.register_buffer("met", self.occupancy.clone())
        self.register_buffer("around", space.box.clone())

    def geometry(self, t: Tensor, points: Tensor, features: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Optical depths ``[M]`` of samples at points ``[M, 3]`` of the space, and the network's ``[M, 16]``.

        ``features``: of the points, where they are known.
        """
        out = self.density(self.hash_grid(self.space.unit(points), features))
        return out[:, 0].clamp_max(DENSEST).exp() * self.space.lengths(t, points), out

    def samples(self, rays: Rays, offset: Tensor | float, cells: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """``t`` ``[M]``, rays ``[M]`` and points ``[M, 3]`` of the space's rays, those outside free space, or in these
        cells ``[V]``.
        """
        grid, stride = self.grid, self.space.stride
        occupancy, around = (self.occupancy, self.around) if cells is None else (cells, self.space.box)
        enter, leave = self.space.ends(rays, around)
        counts = sample_counts(enter, leave, stride, offset)
        buffers = grid.box[0], grid.scale, grid.last, grid.offsets
        first = enter + offset * stride
        return occupied_samples(*rays, first, counts, stride, occupancy, *buffers, self.space.contracted)

    def log_density(self, points: Tensor) -> Tensor:
        """Only the network's first output, ``[M]``, at points ``[M, 3]`` of the space; without gradients."""
        return log_density(*self._looked_up(), self.space.unit(points))

    def lit(self, t: Tensor, ray_index: Tensor, points: Tensor, n_rays: int) -> tuple[Tensor, Tensor | None]:
        """Indices ``[N]`` of the samples ``[M]`` with alpha that light reaches, and their features: what the others are
        changes next to nothing.
        """
        lengths = self.space.lengths(t, points)
        lengths = lengths if isinstance(lengths, Tensor) else t.new_full((1,), lengths)
        return lit(*self._looked_up(), self.space.unit(points), lengths, ray_index, n_rays, self.threshold)

    def _looked_up(self) -> tuple[Tensor, Tensor, Tensor, nn.Linear, nn.Linear]:
        grid, layers = self.hash_grid, self.density.layers
        return grid.table, grid.sides, grid.starts, layers[0], layers[2]

    def forward(self, rays: Rays, background: Tensor, offset: Tensor | float) -> tuple[Tensor, Tensor, Samples]:
        """Render rays: latent ``[R, k]``, expected depth ``[R]``, and the samples behind them.

        Samples that light reaches are found first, and go through the networks again for their gradients.
        """
        n_rays = len(rays.origins)
        with record_function("ctm/samples"):
            t, ray_index, points = self.samples(self.space.local(rays), offset)
            index, features = self.lit(t, ray_index, points, n_rays)
            t, ray_index, points = taken(index, t, ray_index, points)
        optical_depth, out = self.geometry(t, points, features)
        return marched(
            optical_depth,
            t,
            ray_index,
            background,
            n_rays=n_rays,
            behind=self.space.behind,
            threshold=self.threshold,
            distances=lambda t, ray_index: self.space.distances(rays, t, ray_index),
            shade=lambda index, ray_index: self.color(*taken(index, out), rays.directions, ray_index),
        )

    def query(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Density ``[M]`` and latent ``[M, k]`` at points of the world, see :meth:`PosedBackbone.query`."""
        local, unit = self.space.place(points)
        low, high = self.space.box
        there = ((local >= low) & (local <= high)).all(1) & self.occupancy[self.grid.nearest(local)]
        out = self.density(self.hash_grid(self.space.unit(torch.minimum(torch.maximum(local, low), high))))
        density = out[:, 0].clamp_max(DENSEST).exp() * unit * there
        return density, self.color(out, directions, torch.arange(len(out), device=out.device))

    @torch.no_grad()
    def update_occupancy(self, draws: Draws, share: float) -> None:
        """Look at random points of a share of the cells, and of as many again out of those not free; at 1 at all cells.

        What was known of every cell fades, the larger number stays.
        """
        count = len(self.alpha)
        if share < 1:
            some, known = max(1, int(share * count)), self.occupancy.nonzero().squeeze(1)
            cells = [draws.integers(count, some)]
            cells += [known[draws.integers(len(known), some)]] if len(known) else []
            cells = torch.cat(cells)
        else:
            cells = torch.arange(count, device=self.alpha.device)
        low, high = self.space.box
        within = (draws.uniform(len(cells), 3) - 0.5) / self.grid.scale
        points = torch.minimum(torch.maximum(self.grid.vertices_at(cells) + within, low), high)
        self.alpha *= DECAY
        longest = self.space.stride / self.space.side
        for index, part in zip(cells.split(CHUNK), points.split(CHUNK), strict=True):
            seen = -torch.expm1(-self.log_density(part).clamp_max(DENSEST).exp() * longest)
            self.alpha.scatter_reduce_(0, index, seen, "amax")
        self.occupy(self.alpha > self.alpha.mean().clamp_max(self.free_below))

    @torch.no_grad()
    def settle(self, below: float, rays: Rays, hull: Callable[[Tensor], Tensor]) -> None:
        """Leave cells free for good that have less alpha, and none of whose neighbours has as much.

        Not those on ``rays`` of the world that meet none with as much, where ``hull``, of points ``[M, 3]``, is true.
        """
        filled = self.alpha >= below
        lost = self.on_those_that_miss(rays, self.allowed & filled)
        rows = lost.nonzero().squeeze(1)
        lost[rows] = hull(self.grid.vertices_at(rows))
        self.allowed &= (dilate(filled.float().view(self.grid.shape)).flatten() > 0) | lost
        self.occupy(self.occupancy)
        self.met = self.occupancy | (self.allowed & lost)

    def on_those_that_miss(self, rays: Rays, cells: Tensor) -> Tensor:
        """``[V]`` boolean: the cells on those rays of the world that meet none of ``cells``, ``[V]``, and those next to
        them, as rays lie apart.
        """
        found, everywhere = torch.zeros_like(cells), torch.ones_like(cells)
        for part in zip(*(each.split(RAYS) for each in self.space.local(rays)), strict=True):
            misses = torch.ones(len(part[0]), dtype=torch.bool, device=cells.device)
            misses[self.samples(Rays(*part), 0.5, cells)[1].long()] = False
            points = self.samples(Rays(*(each[misses] for each in part)), 0.5, everywhere)[2]
            found[self.grid.nearest(points).long()] = True
        return dilate(found.float().view(self.grid.shape)).flatten() > 0

    def hits(self, rays: Rays) -> Tensor:
        """``[R]`` boolean: whether a ray of the world may meet a cell that was not free when cells last settled; errs
        to True.
        """
        rays = self.space.local(rays)
        ends = self.space.ends(rays, self.grid.box_around(self.met))
        return may_meet(rays, *ends, self.grid, self.met, block=2)  # cells are few, and large

    @torch.no_grad()
    def occupy(self, cells: Tensor) -> None:
        """Take all but these cells ``[V]`` for free; rays are looked at in the box ``around`` what is left."""
        self.occupancy = cells & self.allowed
        self.around = self.grid.box_around(self.occupancy)
