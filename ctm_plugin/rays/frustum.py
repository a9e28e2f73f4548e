"""What cameras see of space: boxes round their frusta, and how many see a point."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.data.scene import Views
from ctm_plugin.rays.cameras import Rays, camera_rays


def edge_rays(views: Views, points: int = 33) -> Rays:
    """``points`` x ``points`` rays over each image, its edges included, view after view."""
    x = torch.linspace(0, views.width, points).repeat(points)
    y = torch.linspace(0, views.height, points).repeat_interleave(points)
    each, count = len(x), len(views)
    return camera_rays(
        views.c2w.repeat_interleave(each, 0),
        views.intrinsics.repeat_interleave(each, 0),
        x.repeat(count),
        y.repeat(count),
    )


def frustum_box(views: Views, near: float, far: float) -> Float[Tensor, "2 3"]:
    """Smallest axis-aligned box round all frusta between distances ``near`` and ``far`` along the rays.

    Distances along the rays make the ends of a frustum spherical: its middle reaches further than its corners.
    """
    return ray_box(edge_rays(views), near, far)


def ray_box(rays: Rays, near: float, far: float) -> Float[Tensor, "2 3"]:
    """Smallest axis-aligned box round rays between ``near`` and ``far``."""
    ends = torch.cat([rays.origins + t * rays.directions for t in (near, far)])
    return torch.stack([ends.amin(0), ends.amax(0)])


def view_counts(points: Float[Tensor, "p 3"], views: Views, near: float) -> tuple[Tensor, Tensor]:
    """How many cameras see each point, and whether any camera is nearer to it than ``near``.

    A camera sees a point that projects into its image and is in front of it.

    Returns:
        Counts ``[P]`` float32 and a boolean ``[P]``.
    """
    counts = torch.zeros(len(points), device=points.device)
    too_near = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for c2w, (fx, fy, cx, cy) in zip(views.c2w, views.intrinsics.tolist(), strict=True):
        c2w = c2w.to(points.device)
        offset = points - c2w[:, 3]
        x, y, z = (offset @ c2w[:, :3]).unbind(-1)
        depth = -z
        column, row = cx + fx * x / depth, cy - fy * y / depth
        inside = (column >= 0) & (column <= views.width) & (row >= 0) & (row <= views.height)
        counts += inside & (depth > 0)
        too_near |= offset.square().sum(-1) < near**2
    return counts, too_near
