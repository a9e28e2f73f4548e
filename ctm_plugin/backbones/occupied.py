"""Fields that know where space is empty, and the backbones that train them: samples along rays to their colours.

Samples are *packed*, see :mod:`ctm_plugin.rays.volume`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.profiler import record_function

from ctm_plugin.backbones.averaging import Averaging
from ctm_plugin.backbones.radiance import RadianceBackbone, RayBatch, RayRendering
from ctm_plugin.backbones.spaces import Box
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.draws import Draws
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.grid import VoxelGrid
from ctm_plugin.rays.occupancy import may_meet, occupied_samples
from ctm_plugin.rays.sampling import sample_counts
from ctm_plugin.rays.volume import distortion, occlusion, segment_sums, volume_weights
from ctm_plugin.scene.views import Scene


@dataclass
class Samples:
    """Packed samples that contribute to the colour of their rays.

    Attributes:
        latent: ``[M, k]`` in [0, 1].
        weights: ``[M]`` of volume rendering.
        t: ``[M]``, positions of the samples along the space's rays.
        ray_index: ``[M]``, the ray of each sample.
        transmittance: ``[R]``, behind the last sample of each ray.
    """

    latent: Tensor
    weights: Tensor
    t: Tensor
    ray_index: Tensor
    transmittance: Tensor


Shade = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Latents ``[N, k]`` of samples, from features ``[N, F]``, directions ``[R, 3]`` and the index ``[N]`` of each sample's
direction."""


class OccupiedField(nn.Module):
    """Density and latents in a space, evaluated at samples along rays that an occupancy grid does not call free.

    A subclass gives ``evaluate`` and may give ``reached``.

    Args:
        space: the space that the field fills.
        grid: the occupancy grid.
        alpha_thre: samples with less alpha, or less weight, are skipped.

    Attributes:
        occupancy: ``[V]`` boolean.
        around: ``[2, 3]``, a box with all that is occupied, in which rays are looked at.
    """

    def __init__(self, space: Box, grid: VoxelGrid, alpha_thre: float):
        super().__init__()
        self.space, self.grid, self.alpha_thre = space, grid, alpha_thre
        self.register_buffer("occupancy", torch.ones(grid.count, dtype=torch.bool))
        self.register_buffer("around", space.aabb.clone())

    def evaluate(self, points: Tensor, *known: Tensor) -> tuple[Tensor, Shade]:
        """Densities ``[M]`` (optical depth over one measure of the space) at points ``[M, 3]``, and the samples' shade.

        ``known``: the tensors that ``reached`` gave for these points.
        """
        raise NotImplementedError

    def reached(self, t: Tensor, ray_index: Tensor, points: Tensor, n_rays: int) -> tuple[Tensor, ...]:
        """Keep samples worth a gradient: ``t`` ``[N]``, ``ray_index``, ``points``, what is known there; here all M."""
        return t, ray_index, points

    def samples(self, rays: Rays, offset: Tensor | float, cells: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Sample the space's rays outside free space, or in these cells ``[V]``: positions ``t`` ``[M]``, ray indices
        ``[M]`` and points ``[M, 3]``.
        """
        grid, stride = self.grid, self.space.stride
        occupancy, around = (self.occupancy, self.around) if cells is None else (cells, self.space.aabb)
        enter, leave = self.space.ends(rays, around)
        counts = sample_counts(enter, leave, stride, offset)
        buffers = grid.aabb[0], grid.scale, grid.last, grid.offsets
        first = enter + offset * stride
        return occupied_samples(*rays, first, counts, stride, occupancy, *buffers, self.space.contracted)

    def forward(self, rays: Rays, background: Tensor, offset: Tensor | float) -> tuple[Tensor, Tensor, Samples]:
        """Render the world's rays: latent ``[R, k]``, expected depth ``[R]``, and the samples behind them.

        Only samples whose weight is above ``alpha_thre`` are shaded.

        Args:
            rays: R rays of the world.
            background: ``[R, k]`` or ``[1, k]`` latent.
            offset: shift of the samples as a share of their stride, in [0, 1): ``[R]``, or one for all.
        """
        n_rays = len(rays.origins)
        with record_function("ctm/samples"):
            t, ray_index, points, *known = self.reached(*self.samples(self.space.local(rays), offset), n_rays)
        density, shade = self.evaluate(points, *known)
        optical_depth = density * self.space.lengths(t, points)
        keep = (optical_depth.detach() > -math.log1p(-self.alpha_thre)).nonzero().squeeze(1)
        optical_depth, t, ray_index = taken(keep, optical_depth, t, ray_index)
        weights, transmittance = volume_weights(optical_depth, ray_index, n_rays)
        with torch.no_grad():
            distances = self.space.distances(rays, t, ray_index)
            depth = segment_sums(weights * distances, ray_index, n_rays) + transmittance * self.space.behind

        seen = (weights.detach() > self.alpha_thre).nonzero().squeeze(1)
        weights, t, keep, ray_index = taken(seen, weights, t, keep, ray_index)
        latent = shade(keep, rays.directions, ray_index)
        light = segment_sums(weights[:, None] * latent, ray_index, n_rays)
        rendered = light + transmittance[:, None] * background
        return rendered, depth, Samples(latent, weights, t, ray_index, transmittance)

    def query(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Density ``[M]`` and latent ``[M, k]`` at points of the world, see :meth:`PosedBackbone.query`."""
        local, unit = self.space.place(points)
        low, high = self.space.aabb
        there = ((local >= low) & (local <= high)).all(1) & self.occupancy[self.grid.nearest(local)]
        density, shade = self.evaluate(torch.minimum(torch.maximum(local, low), high))
        every = torch.arange(len(points), device=points.device)
        return density * unit * there, shade(every, directions, every)

    @torch.no_grad()
    def hits(self, rays: Rays) -> Tensor:
        """``[R]`` boolean: whether a ray of the world may meet an occupied cell; errs to True."""
        rays = self.space.local(rays)
        return may_meet(rays, *self.space.ends(rays, self.space.aabb), self.grid, self.occupancy)


def taken(keep: Tensor, *tables: Tensor) -> tuple[Tensor, ...]:
    """Rows of tables ``[M, ...]`` at ``keep`` ``[N]``; the tables themselves where all are kept.

    ``index_select`` as indexing takes two to three times as long, and out of columns, as points are, twenty times.
    """
    if len(keep) == len(tables[0]):
        return tables
    return tuple(
        table.T.index_select(1, keep).T if table.ndim == 2 and table.T.is_contiguous() else table.index_select(0, keep)
        for table in tables
    )


@dataclass
class OccupiedRendering(RayRendering):
    """A rendering with the samples it was made of."""

    samples: Samples


class OccupiedBackbone(Averaging, RadianceBackbone):
    """A backbone whose ``field``, which a subclass makes, is an :class:`OccupiedField`.

    Args:
        config: with ``rays``, ``rays_per_pixel``, ``relative``, ``averaged``, ``start``, ``distortion``, ``occlusion``.
        scene, transform, photometric, seed: see :class:`RadianceBackbone`.
    """

    field: OccupiedField

    def __init__(
        self, config: Any, scene: Scene, transform: ColorTransform | None, photometric: Photometric | None, seed: int
    ):  # fmt: skip
        super().__init__(scene, config.rays, transform, photometric, seed)
        self.config = config
        self.relative, self.rays_per_pixel = config.relative, config.rays_per_pixel
        self.mean_field = None

    def color_biases(self) -> list[Tensor]:
        return [self.field.color.layers[-1].bias] if self.config.start == "mean" else []

    def render(self, rays: Rays, background: Tensor, draws: Draws | None) -> OccupiedRendering:
        offset = 0.5 if draws is None else draws.uniform(len(rays.origins), 1).squeeze(1)
        latent, depth, samples = self.pictured_field(rays, background, offset)
        return OccupiedRendering((latent,), opacity=1 - samples.transmittance.detach(), depth=depth, samples=samples)

    def query(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        return self.pictured_field.query(points, directions)

    def regularisers(self, batch: RayBatch, rendering: OccupiedRendering, target: Tensor) -> dict[str, Tensor]:
        """Distortion of the weights along a ray, and their nearness to its camera, in shares of the way from near to
        far. ``target``: ``[R, k]``."""
        space, samples, terms = self.field.space, rendering.samples, {}
        whole = space.far - space.near
        along = (samples.t - space.near) / whole
        if weight := self.config.distortion:
            term = distortion(samples.weights, along, samples.ray_index, len(target), space.stride / whole)
            terms["distortion"] = weight * term
        if weight := self.config.occlusion:
            terms["occlusion"] = weight * occlusion(samples.weights, along, len(target))
        return terms

    def stats(self) -> dict[str, float]:
        return {"occupied_fraction": self.field.occupancy.float().mean().item()}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_save_checkpoint(checkpoint)
        checkpoint["loss_scale"] = self.loss_scale

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_load_checkpoint(checkpoint)
        self.set_loss_scale(checkpoint["loss_scale"])
