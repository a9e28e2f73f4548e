"""Surface of a field: a cloud of points that its training views see."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.backbones.posed import PosedBackbone
from ctm_plugin.errors import CTMError
from ctm_plugin.metrics.precision import full_float32
from ctm_plugin.show.bars import tracked

MAX_DEPTH_STEP = 0.1
"""Largest relative difference of neighbouring pixels' depths on one surface."""


class Surface(NamedTuple):
    """Points of a surface, in the scene's world, on the CPU.

    Attributes:
        points, normals: ``[P, 3]``; normals have unit length and point out of matter.
        colors: ``[P, 3]`` sRGB in [0, 1].
    """

    points: Float[Tensor, "p 3"]
    normals: Float[Tensor, "p 3"]
    colors: Float[Tensor, "p 3"]


def spanned(points: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Normals, of either sign, of the surface through a picture's neighbouring points; 0 without neighbours."""
    around = F.pad(points.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="replicate")[0]
    across, down = around[:, 1:-1, 2:] - around[:, 1:-1, :-2], around[:, 2:, 1:-1] - around[:, :-2, 1:-1]
    return F.normalize(torch.linalg.cross(across, down, dim=0), dim=0).permute(1, 2, 0)


@torch.no_grad()
def cloud(module: PosedBackbone, max_points: int, opaque: float) -> Surface:
    """Cloud of the points where the training views' rays end, with the colours rendered there.

    Normals are those of the surface through neighbouring end points.

    Args:
        module: the backbone with trained weights.
        max_points: most points over all views, which are thinned evenly.
        opaque: share of a ray's light that matter must stop.

    Raises:
        CTMError: no ray meets such matter.
    """
    scene, views = module.scene, module.scene.train
    every = max(1, math.ceil(math.sqrt(len(views) * views.height * views.width / max_points)))
    parts = []
    with full_float32(module.device):
        for index in tracked(range(len(views)), "views"):
            view = module.render_view(views, index, every, rays=1)
            pixel = torch.arange(views.height * views.width, device=module.device).view(views.height, views.width)
            own = pixel[::every, ::every].flatten() + index * views.height * views.width
            rays = module.training_rays(own)
            # Light that nothing stops counts as stopped at far.
            along = (view["depth"] - (1 - view["opacity"]) * scene.far) / view["opacity"].clamp_min(1e-6)
            there = view["opacity"] >= opaque
            seen = torch.where(there, along, scene.far)[None]
            jump = (F.max_pool2d(seen, 3, 1, 1) + F.max_pool2d(-seen, 3, 1, 1))[0]
            keep = (there & (jump <= MAX_DEPTH_STEP * along)).flatten()
            if views.mask is not None:
                keep &= views.mask[index].to(module.device).flatten()[own - index * views.height * views.width]
            points = rays.origins + along.flatten()[:, None] * rays.directions
            normal = spanned(points.unflatten(0, along.shape)).flatten(0, 1)[keep]
            points, directions = points[keep], rays.directions[keep]
            facing = (normal * directions).sum(1, keepdim=True)
            # What is seen faces the camera; where no neighbour tells, straight.
            normal = torch.where(facing == 0, -directions, -normal * facing.sign())
            parts.append((points, normal, view["rgb"].flatten(0, 1)[keep]))
    points, normal, colors = (torch.cat(part).float().cpu() for part in zip(*parts, strict=True))
    if not len(points):
        raise CTMError(f"no ray of the training views stops {opaque:g} of its light; a lower opaque finds more")
    return Surface(points, normal, colors.clamp(0, 1))
