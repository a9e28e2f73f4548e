"""DVGO's field for forward-facing scenes: planes of voxels in normalised device coordinates."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ctm_plugin.backbones.voxels import VoxelField
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.grid import Shape
from ctm_plugin.rays.ndc import NDC

BASE_PLANES = 256
"""Planes of which one has the optical depth ``softplus(raw density)``; fewer planes are as much thicker."""


class MultiplaneField(VoxelField):
    """A grid in NDC: x and y over the images, z from the near plane, -1, to infinity, 1.

    A fresh grid gives all planes the same weight, so that no depth is preferred: with D planes the i-th has
    ``alpha_i = g / (1 - i g)``, ``g = 1/D - 1e-6``; the shift of its density follows from it.

    Args:
        box: ``[2, 3]`` in NDC.
        shape: vertices along each side; the third is the number of planes D.
        features: channels of the feature table.
        ndc: the coordinates.
        far: distance in the world at which light that nothing stops counts as stopped.
        threshold: samples with less alpha, or less weight, are skipped.
        step: distance between samples, in planes.
    """

    def __init__(
        self, box: Tensor, shape: Shape, features: int, *, ndc: NDC, far: float, threshold: float, step: float
    ):
        super().__init__(box, shape, features, near=0.0, far=1.0, behind=far, threshold=threshold)
        self.ndc = ndc
        self.step = step
        planes = shape[2]
        each = 1 / planes - 1e-6
        alpha = each / (1 - each * torch.arange(planes, dtype=torch.float64))
        # softplus(shift) BASE_PLANES / D = -ln(1 - alpha): one step of a whole plane has that alpha.
        shift = torch.expm1(-torch.log1p(-alpha) * planes / BASE_PLANES).log()
        self.register_buffer("vertex_shift", shift.float(), persistent=False)

    @property
    def stride(self) -> float:
        return self.step / (self.grid.shape[2] - 1)  # t runs from 0 to 1 through all planes

    @property
    def interval(self) -> float:
        return self.step * BASE_PLANES / self.grid.shape[2]

    def shift_at(self, points: Tensor) -> Tensor:
        """Interpolate between the planes on both sides of points ``[M, 3]``: ``[M]``."""
        last = len(self.vertex_shift) - 1
        position = ((points[:, 2] - self.grid.box[0, 2]) * self.grid.scale[2]).clamp(0, last)
        below = position.floor().clamp_max(last - 1)
        index = below.long()
        return torch.lerp(self.vertex_shift[index], self.vertex_shift[index + 1], position - below)

    def place(self, points: Tensor) -> tuple[Tensor, Tensor]:
        return self.ndc.points(points)

    def local(self, rays: Rays) -> Rays:
        return self.ndc.rays(rays)

    def distances(self, rays: Rays, t: Tensor, ray_index: Tensor) -> Tensor:
        return self.ndc.distances(rays[ray_index], t, self.behind)


def plane_shape(box: Tensor, voxels: int, planes: int) -> Shape:
    """Count vertices along each side of a box ``[2, 3]``: ``planes`` planes, some ``voxels`` voxels, square in x, y."""
    width, height, _ = (box[1] - box[0]).tolist()
    size = math.sqrt(width * height * planes / voxels)
    return max(2, int(width / size + 1e-3)), max(2, int(height / size + 1e-3)), planes
