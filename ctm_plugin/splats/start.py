"""Initial Gaussians: at a reconstruction's points, else at random points that training cameras see."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from ctm_plugin.draws import Draws
from ctm_plugin.rays.cameras import pixel_rays
from ctm_plugin.scene.frustum import projected, view_counts, visual_hull
from ctm_plugin.scene.views import Scene, composite
from ctm_plugin.splats.gaussians import Gaussians
from ctm_plugin.splats.plane_sweep import swept_places

MIN_POINTS = 300
"""Least number of a reconstruction's points to start from."""
START_OPACITY = 0.1
"""Initial opacity of a Gaussian."""
DRAWS_PER_POINT = 8
"""Random points drawn for each that is wanted: most are seen by too few cameras, or lie outside an object."""
MIN_VIEWS = 3
"""Least number of training views that see a random point."""
NEIGHBOURS = 3
"""Nearest neighbours whose root mean square distance is a Gaussian's initial scale."""
SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic, 1 / (2 sqrt(pi))."""


def first_places(scene: Scene, count: int, seed: int) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Choose the initial positions of Gaussians, and the sRGB colours that training pictures have there.

    Args:
        scene: scene whose ``points`` are taken; where they are fewer than 300, random ones and a plane sweep's are
            added.
        count: number of random points.
        seed: seed of the random points, and of the sweep's.
    """
    points = scene.points
    given = torch.empty(0, 3) if points is None else points.positions
    drawn = random_places(scene, count, seed) if len(given) < MIN_POINTS else torch.empty(0, 3)
    places = torch.cat([given, drawn])
    tracked = torch.zeros(0, 2, dtype=torch.long)
    if points is not None and len(points.point):
        tracked = torch.stack([points.point, points.view], 1)
    colors = colors_of(scene, places, tracked)
    swept, shown = swept_places(scene, seed) if len(drawn) else (drawn, drawn)
    return torch.cat([places, swept]), torch.cat([colors, shown])


def random_places(scene: Scene, count: int, seed: int) -> Float[Tensor, "n 3"]:
    """Draw places between near and far on random pixels' rays that other views see too; inside the hull of an object.

    At most ``count`` places are given, the first ones that remain.
    """
    views, draws = scene.train, Draws(seed, 0, stream="places")
    drawn = DRAWS_PER_POINT * count
    pixel = draws.integers(len(views) * views.height * views.width, drawn)
    rays = pixel_rays(views.c2w, views.intrinsics, views.height, views.width, pixel, views.distortion)
    part = draws.uniform(drawn, 1)
    # Evenly along the rays of a bounded scene, else evenly in their inverse: most lies near the cameras.
    inverse = 1 / (1 / max(scene.near, 1e-3 * scene.far) * (1 - part) + part / scene.far)
    t = scene.near + (scene.far - scene.near) * part if scene.geometry == "bounded" else inverse
    places = rays.origins + t * rays.directions
    seen, _ = view_counts(places, views, 0.0)
    keep = seen >= min(MIN_VIEWS, len(views))
    if views.has_alpha and scene.geometry == "bounded":
        hull = keep & visual_hull(places, views, 0.0)
        keep = hull if hull.sum() >= MIN_POINTS else keep
    return places[keep][:count] if keep.any() else places[:count]


def colors_of(scene: Scene, places: Float[Tensor, "n 3"], tracked: Tensor) -> Float[Tensor, "n 3"]:
    """Mean sRGB colours of places in the training pictures that see them by ``tracked``, ``[T, 2]`` (place, view).
    Other places get the mean over all pictures that have them in their frame, or grey. Masked pixels do not
    count.
    """
    views, background = scene.train, torch.full((3,), float(scene.background == "white"))
    sums, counts = torch.zeros(len(places), 3), torch.zeros(len(places), 1)
    untracked = torch.ones(len(places), dtype=torch.bool)
    untracked[tracked[:, 0]] = False
    for view in range(len(views)):
        column, row, _, seen = projected(places, views, view)
        wanted = untracked.clone()
        wanted[tracked[tracked[:, 1] == view, 0]] = True
        at = (seen & wanted).nonzero().squeeze(1)
        x, y = column[at].long().clamp(0, views.width - 1), row[at].long().clamp(0, views.height - 1)
        if views.mask is not None:
            counted = views.mask[view, y, x].to(at.device)
            at, x, y = at[counted], x[counted], y[counted]
        sums[at] += composite(views.images[view, y, x].cpu(), background)
        counts[at] += 1
    return torch.where(counts > 0, sums / counts.clamp_min(1), 0.5)


def first_gaussians(places: Float[Tensor, "n 3"], colors: Float[Tensor, "n k"], degree: int) -> Gaussians:
    """Make isotropic Gaussians at places, as large as their neighbours' distance, with colours alike from all sides."""
    count, channels = colors.shape
    apart = cKDTree(places.numpy()).query(places.numpy(), min(NEIGHBOURS, max(count - 1, 1)) + 1)[0][:, 1:]
    size = torch.from_numpy(np.sqrt((apart**2).mean(1)).clip(1e-7, 1e7)).float().log()
    return Gaussians(
        means=places.clone(),
        scales=size[:, None].repeat(1, 3),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        opacities=torch.full((count, 1), START_OPACITY).logit(),
        sh0=(colors - 0.5) / SH_C0,
        shN=torch.zeros(count, ((degree + 1) ** 2 - 1) * channels),
    )
