"""DVGO on forward-facing scenes: planes of voxels in normalised device coordinates, no coarse stage."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.optim import Optimizer

from ctm_plugin.backbones.dvgo import DVGO, VoxelRendering
from ctm_plugin.backbones.multiplane import MultiplaneField, plane_shape
from ctm_plugin.backbones.radiance import RayBatch
from ctm_plugin.rays.grid import Shape, add_smoothing
from ctm_plugin.rays.ndc import NDC
from ctm_plugin.rays.volume import distortion
from ctm_plugin.scene.frustum import edge_rays, ndc_of, ray_box

TV_PLANES = 128
"""Total variation is weighted by the grid's side over this, as finer grids have smaller differences."""


class ForwardDVGO(DVGO):
    """A multiplane grid with total variation and distortion losses (DVGO's own setting for LLFF scenes)."""

    def starting_box(self) -> Tensor:
        box = ray_box(self._ndc.rays(edge_rays(self.scene.train)), 0.0, 1.0)
        box[:, 2] = torch.tensor([-1.0, 1.0])  # but for rounding
        return box

    def make_field(self, box: Tensor, shape: Shape | None = None) -> MultiplaneField:
        return MultiplaneField(
            box,
            shape or self.grown_shape(box),
            self.config.features,
            ndc=self._ndc,
            far=self.scene.far,
            threshold=self.config.threshold,
            step=self.config.step_size,
        )

    @property
    def _ndc(self) -> NDC:
        return ndc_of(self.scene)

    def grown_shape(self, box: Tensor) -> Shape:
        return plane_shape(box, self.fine_voxels, self.config.planes)

    def renew_pool(self) -> None:
        """All pixels are drawn from: in front of a scene nearly every ray meets something."""

    def regularisers(self, batch: RayBatch, rendering: VoxelRendering, target: Tensor) -> dict[str, Tensor]:
        """Those of all DVGOs, and the distortion loss along the rays in NDC."""
        terms = super().regularisers(batch, rendering, target)
        if weight := self.config.distortion:
            samples = rendering.samples
            loss = distortion(samples.weights, samples.t, samples.ray, len(target), self.field.stride)
            terms["distortion"] = weight * loss
        return terms

    def allows_sparse(self) -> bool:
        return super().allows_sparse() and not (self.config.tv_density or self.config.tv_features)

    def on_before_optimizer_step(self, optimizer: Optimizer) -> None:
        """Total variation goes straight into the gradients: as a loss it would need several copies of the grids."""
        x, y, z = self.field.lattice.shape
        side = max(x, y)
        seen_only = self.global_step >= self.config.tv_dense_steps
        weights = {self.field.density: self.config.tv_density, self.field.features: self.config.tv_features}
        for table, weight in weights.items():
            if weight and table.grad is not None:
                each = weight / self.config.rays / 6 / TV_PLANES
                add_smoothing(table, (x, y, z), (each * side, each * side, each * z), seen_only)
