"""Space that cameras see: boxes round their frusta, visibility of points, the visual hull, and NDC's cube."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from ctm_plugin.errors import DataError
from ctm_plugin.rays.cameras import Rays, camera_rays, distort, undistort
from ctm_plugin.rays.ndc import MIN_FORWARD, NDC
from ctm_plugin.scene.poses import meeting_point
from ctm_plugin.scene.views import Scene, Views


def edge_points(extents: Tensor, points: int = 33) -> tuple[Tensor, Tensor]:
    """x and y ``[..., points^2]`` in pixels, a regular grid over pictures of ``extents`` (width, height) ``[..., 2]``.

    ``points`` lie on a side, the first and the last on the picture's borders.
    """
    part = torch.linspace(0, 1, points)
    return extents[..., :1] * part.repeat(points), extents[..., 1:] * part.repeat_interleave(points)


def edge_rays(views: Views, points: int = 33) -> Rays:
    """``points`` x ``points`` rays over the part of each image that counts, its edges included, view after view."""
    x, y = edge_points(views.extents, points)
    each = x.shape[1]
    return camera_rays(
        views.c2w.repeat_interleave(each, 0),
        views.intrinsics.repeat_interleave(each, 0),
        x.flatten(),
        y.flatten(),
        None if views.distortion is None else views.distortion.repeat_interleave(each, 0),
    )


def widest(views: Views) -> float:
    """The largest ratio of distance along a ray to depth along its camera's axis, at least 1."""
    rays = edge_rays(views)
    forward = -views.c2w[:, :, 2].repeat_interleave(len(rays.origins) // len(views), 0)
    return float(1.0 / (rays.directions * forward).sum(-1).min())


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
    """Number of cameras that see each point, and whether any camera is nearer to it than ``near``.

    A camera sees a point that projects into its image and is in front of it.

    Returns:
        Counts ``[P]`` float32 and a boolean ``[P]``.
    """
    counts = torch.zeros(len(points), device=points.device)
    too_near = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for view in range(len(views)):
        counts += projected(points, views, view).seen
        offset = points - views.c2w[view].to(points.device)[:, 3]
        too_near |= offset.square().sum(-1) < near**2
    return counts, too_near


def visual_hull(points: Float[Tensor, "p 3"], views: Views, radius: float) -> Bool[Tensor, " p"]:
    """Tell round which points, up to ``radius``, the pictures leave room for something (Laurentini, 1994).

    All cameras that see the point have a pixel there whose alpha is not 0, or a masked one. Points that no camera sees
    are left out. The ball's stretching by a lens is ignored.

    Args:
        views: pictures with alpha.
    """
    hull = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    empty = hull.clone()
    for view in range(len(views)):
        column, row, depth, seen = projected(points, views, view)
        if not seen.any():
            continue
        hull |= seen
        filled = views.images[view, ..., 3] > 0
        if views.mask is not None:
            filled |= ~views.mask[view]
        if not filled.any():
            empty |= seen
            continue
        # Beside a camera a point has no place in its picture.
        x, y = (at.nan_to_num().clamp(0, n - 1).long() for at, n in ((column, views.width), (row, views.height)))
        pixels = torch.from_numpy(distance_transform_edt(~filled.cpu().numpy())).to(points)[y, x]
        focal = views.intrinsics[view, :2].max().item()
        offset = points - views.c2w[view].to(points)[:, 3]
        # From one pixel's middle to another's: a point and what fills a pixel may lie nearer by a pixel's diagonal.
        empty |= seen & (pixels > focal * reach(offset.square().sum(-1), depth, radius) + math.sqrt(2))
    return hull & ~empty


def reach(square: Float[Tensor, " p"], depth: Float[Tensor, " p"], radius: float) -> Float[Tensor, " p"]:
    """Largest distance in a picture from a ball's middle to its outline, in focal lengths: away from the axis.

    ``tan(a + b) - tan a``, a the middle's angle from the axis and ``sin b = radius / distance``; infinite where the
    ball reaches past the camera.

    Args:
        square: squared distance from the camera to the ball's middle.
        depth: depth of the ball's middle along the camera's axis, > 0.
    """
    steep = (square / depth.square() - 1).clamp_min(0).sqrt()
    wide = radius / (square - radius**2).clamp_min(0).sqrt()
    left = 1 - steep * wide
    return torch.where(left > 0, wide * (1 + steep.square()) / left, math.inf)


class ProjectedPoints(NamedTuple):
    """Points projected into a view: ``[P]`` columns and rows in pixels, depths, and whether the view sees them."""

    column: Tensor
    row: Tensor
    depth: Tensor
    seen: Tensor


def projected(points: Float[Tensor, "p 3"], views: Views, view: int) -> ProjectedPoints:
    """Project points into a view, through its lens."""
    fx, fy, cx, cy = views.intrinsics[view].tolist()
    c2w = views.c2w[view].to(points)
    x, y, z = ((points - c2w[:, 3]) @ c2w[:, :3]).unbind(-1)
    depth = -z
    u, v = x / depth, -y / depth
    seen = depth > 0
    if views.distortion is not None:
        lens, edge = views.distortion[view], edge_points(views.extents[view])
        edge_u, edge_v = undistort((edge[0] - cx) / fx, (edge[1] - cy) / fy, lens)
        # Far outside the image the polynomial turns back and would put points into it.
        seen &= u.square() + v.square() <= (edge_u.square() + edge_v.square()).max().item()
        u, v = distort(u, v, lens.to(points.device))
    column, row = cx + fx * u, cy + fy * v
    width, height = views.extents[view].tolist()
    inside = (column >= 0) & (column <= width) & (row >= 0) & (row <= height)
    return ProjectedPoints(column, row, depth, inside & seen)


def camera_ball(views: Views, near: float) -> tuple[Float[Tensor, " 3"], float]:
    """Centre and radius of the ball round all cameras, outside which an unbounded scene is contracted.

    Round the point where their axes meet, else round their mean; no smaller than ``near``.
    """
    c2w = views.c2w.double().numpy()
    point = meeting_point(c2w)
    centre = c2w[:, :, 3].mean(0) if point is None else point
    radius = max(float(np.linalg.norm(c2w[:, :, 3] - centre, axis=1).max()), near)
    return torch.from_numpy(centre).float(), radius


def ndc_of(scene: Scene) -> NDC:
    """The normalised device coordinates of a forward-facing scene, whose mean camera stands at the origin.

    Raises:
        DataError: a camera looks sideways or back.
    """
    fx, fy, _, _ = scene.train.intrinsics.mean(0).tolist()
    for views in (scene.train, scene.test):
        steep = (edge_rays(views).directions[:, 2] > -MIN_FORWARD).reshape(len(views), -1).any(1)
        if steep.any():
            found = f"view {views.names[int(steep.nonzero()[0])]}, which looks sideways or back"
            raise DataError(scene.name, found, "cameras that all look one way (dataset.geometry=forward)")
    return NDC(2 * fx / scene.train.width, 2 * fy / scene.train.height, scene.near)
