"""Normalised device coordinates: the frustum of a camera, however deep, as a cube."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.rays.cameras import Rays

MIN_FORWARD = 0.05
"""Least part of a ray's direction along -z: nearly 3 degrees off the image plane, where coordinates blow up."""


class NDC(NamedTuple):
    """Normalised device coordinates (Mildenhall et al., ECCV 2020, appendix C) of a camera that looks along -z, y up.

    A point (x, y, z) with depth -z in [near, inf) has the coordinates
    ``(-scale_x x / z, -scale_y y / z, 1 + 2 near / z)``: z runs from -1 at the near plane to 1 at infinity, x and y
    from -1 to 1 over the image. Straight lines stay straight.

    Attributes:
        scale_x, scale_y: focal length over half the image's side.
        near: depth of the near plane, > 0, in scene units.
    """

    scale_x: float
    scale_y: float
    near: float

    def rays(self, rays: Rays) -> Rays:
        """Transform rays into NDC: ``t`` = 0 on the near plane, 1 at infinity. Directions are not of unit length.

        Args:
            rays: R rays in the world, directions with z < 0.
        """
        slope = rays.directions[:, :2] / -rays.directions[:, 2:]
        # On the near plane -x / z = x / near, and x grows by the slope for each unit of depth.
        start = (rays.origins[:, :2] + (self.near + rays.origins[:, 2:]) * slope) / self.near
        (x, y), (along_x, along_y) = start.unbind(1), (slope - start).unbind(1)
        ones = torch.ones_like(x)
        return Rays(
            torch.stack([self.scale_x * x, self.scale_y * y, -ones], dim=1),
            torch.stack([self.scale_x * along_x, self.scale_y * along_y, 2 * ones], dim=1),
        )

    def points(self, points: Float[Tensor, "m 3"]) -> tuple[Float[Tensor, "m 3"], Float[Tensor, " m"]]:
        """Transform points of the world into NDC; give also the change of ``t`` a unit of depth, ``near / depth^2``.

        Args:
            points: with z < 0; what lies nearer than a thousandth of ``near`` counts as there.
        """
        depth = (-points[:, 2]).clamp_min(1e-3 * self.near)
        x, y = points[:, 0] / depth, points[:, 1] / depth
        local = torch.stack([self.scale_x * x, self.scale_y * y, 1 - 2 * self.near / depth], dim=1)
        return local, self.near / depth.square()

    def distances(self, rays: Rays, t: Float[Tensor, "*r"], far: float) -> Float[Tensor, "*r"]:
        """Find distances along the world's rays, up to ``far``, of the points at ``t`` in [0, 1] along those of NDC.

        Depth is ``near / (1 - t)``. The rays, ``[..., 3]``, are broadcast with ``t``.
        """
        depth = self.near / (1 - t).clamp_min(1e-6)
        return ((-depth - rays.origins[..., 2]) / rays.directions[..., 2]).clamp_max(far)
