"""DVGO on forward-facing scenes: planes of voxels in normalised device coordinates, no coarse stage."""

from __future__ import annotations

import torch
from torch import Tensor

from ctm_plugin.backbones.dvgo import DVGO
from ctm_plugin.backbones.multiplane import MultiplaneField, plane_shape
from ctm_plugin.rays.grid import Shape
from ctm_plugin.rays.ndc import NDC
from ctm_plugin.scene.frustum import edge_rays, ndc_of, ray_box


class ForwardDVGO(DVGO):
    """A multiplane grid with total variation and distortion losses (DVGO's own setting for LLFF scenes)."""

    mlp_width, view_frequencies = 64, 0  # the plain direction

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

    def smoothed_sides(self) -> tuple[int, int, int]:
        x, y, planes = self.field.grid.shape
        return max(x, y), max(x, y), planes
