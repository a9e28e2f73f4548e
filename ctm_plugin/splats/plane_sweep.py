"""Plane sweep: more first places, where small patches of neighbouring pictures look alike."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from ctm_plugin.draws import Draws
from ctm_plugin.rays.cameras import Rays, pixel_rays
from ctm_plugin.scene.frustum import projected
from ctm_plugin.scene.views import Scene, Views
from ctm_plugin.splats.coarse_to_fine import averaged

SIDE = 2
"""Side in pixels of the squares that pictures are averaged over: less noise."""
STRIDE = 8
"""Pixels of the averaged pictures from one patch to the next."""
PATCH = 5
"""Pixels along a patch."""
DEPTHS = 64
"""Number of depths that are tried, evenly in their inverse from near to far."""
NEIGHBOURS = 4
"""Nearest views that a patch is looked for in; two of them must show it."""
MIN_LIKENESS = 0.8
"""Least normalised correlation of a patch with those of two neighbours."""
MIN_CONTRAST = 0.5
"""Least standard deviation of a patch, in medians of its picture's: flat ones are alike everywhere."""
MIN_COSINE = 0.8
"""Least cosine between the axes of neighbours."""
AT_ONCE = 1024
"""Patches that are looked for together, some 100 MB."""
MAX_VIEWS = 40
"""Most views whose patches are looked for; of fewer pictures every second one."""


def swept_places(scene: Scene, seed: int) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Find places by a plane sweep (Collins 1996), and the sRGB colours of their pictures there.

    A patch's place is at the depth where its second best neighbour is most alike. A start from many matches is EDGS's
    idea (Kotovenko et al. 2025). Scenes with alpha, and those of fewer than three views, get none.
    """
    views = scene.train
    found = [(torch.empty(0, 3), torch.empty(0, 3))]
    if len(views) > 2 and not views.has_alpha and min(views.height, views.width) >= SIDE * (STRIDE + PATCH):
        small = averaged(views, SIDE)
        shown = small.images.cpu().permute(0, 3, 1, 2)
        grey, draws = shown.mean(1, keepdim=True), Draws(seed, 0, stream="sweep")
        for view in range(0, len(views), max(2, -(-len(views) // MAX_VIEWS))):
            for pixel in patches(small, grey[view, 0], view, draws).split(AT_ONCE):
                places = matched(small, grey, view, pixel, scene.near, scene.far)
                kept = places.isfinite().all(1)
                found.append((places[kept], shown[view].flatten(1).T[pixel[kept]]))
    places, colors = zip(*found, strict=True)
    return torch.cat(places), torch.cat(colors)


def patches(views: Views, grey: Float[Tensor, "h w"], view: int, draws: Draws) -> Int64[Tensor, " m"]:
    """Flat indices of the middles of a picture's patches: a grid at a random offset, without what is flat or masked."""
    margin = PATCH // 2
    right, down = draws.integers(STRIDE, 2).tolist()
    rows = torch.arange(margin + down, views.height - margin, STRIDE)
    columns = torch.arange(margin + right, views.width - margin, STRIDE)
    pixel = (rows[:, None] * views.width + columns).flatten()
    contrast = grey.flatten()[around(pixel, views.width)].std(1)
    kept = contrast > MIN_CONTRAST * contrast.median()
    if views.mask is not None:
        kept &= views.mask[view].cpu().flatten()[around(pixel, views.width)].all(1)
    return pixel[kept]


def around(pixel: Int64[Tensor, " m"], width: int) -> Int64[Tensor, "m p"]:
    """Flat indices of the pixels of patches round their middles, row by row."""
    reach = torch.arange(PATCH) - PATCH // 2
    return pixel[:, None] + (reach[:, None] * width + reach).flatten()


def matched(
    views: Views, grey: Float[Tensor, "v 1 h w"], view: int, pixel: Int64[Tensor, " m"], near: float, far: float
) -> Float[Tensor, "m 3"]:
    """Places of a view's patches, from the depth at which two neighbours are most alike; NaN where they are not."""
    whole = around(pixel, views.width)
    rays = pixel_rays(
        views.c2w, views.intrinsics, views.height, views.width, whole.flatten() + view * grey[0].numel(),
        views.distortion,
    )  # fmt: skip
    inverse = torch.linspace(1 / far, 1 / max(near, 1e-3 * far), DEPTHS)
    wanted = normalised(grey[view].flatten()[whole])[:, None]
    likeness = torch.full((2, len(pixel), DEPTHS), -1.0)
    for other in neighbours(views, view):
        there, seen = seen_from(views, grey, view, other, rays, inverse)
        alike = (normalised(there) * wanted).sum(-1).where(seen, -1.0)
        likeness = torch.cat([likeness, alike[None]]).topk(2, 0).values
    second = likeness[1]
    best, at = second.max(1)
    inner = at.clamp(1, DEPTHS - 2)
    before, here, after = second.gather(1, inner[:, None] + torch.arange(-1, 2)).unbind(1)
    # The vertex of the parabola through three depths' likeness.
    offset = (0.5 * (before - after) / (before - 2 * here + after).clamp_max(-1e-6)).clamp(-0.5, 0.5)
    depth = 1 / (inverse[0] + (inner + offset) * (inverse[1] - inverse[0]))
    middle = rays[torch.arange(len(pixel)) * PATCH**2 + PATCH**2 // 2]
    places = middle.origins + (depth / cosines(views, view, middle))[:, None] * middle.directions
    return places.where(((best > MIN_LIKENESS) & (at == inner))[:, None], torch.nan)


def neighbours(views: Views, view: int) -> list[int]:
    """The nearest views that look the same way."""
    away = (views.c2w[:, :, 3] - views.c2w[view, :, 3]).norm(dim=1)
    along = (views.c2w[:, :, 2] * views.c2w[view, :, 2]).sum(1) > MIN_COSINE
    return [other for other in away.argsort().tolist() if other != view and along[other]][:NEIGHBOURS]


def seen_from(
    views: Views, grey: Float[Tensor, "v 1 h w"], view: int, other: int, rays: Rays, inverse: Float[Tensor, " d"]
) -> tuple[Float[Tensor, "m d p"], Bool[Tensor, "m d"]]:
    """What another view shows of the rays' patches at each depth, and whether it has them in its frame."""
    depths = 1 / (inverse * cosines(views, view, rays)[:, None])
    places = rays.origins[:, None] + depths[..., None] * rays.directions[:, None]
    column, row, _, seen = projected(places.flatten(0, 1), views, other)
    at = torch.stack([column / views.width, row / views.height], 1) * 2 - 1
    shown = F.grid_sample(grey[other][None], at[None, None], align_corners=False)[0, 0, 0]
    shape = (-1, PATCH**2, len(inverse))
    return shown.view(shape).transpose(1, 2), seen.view(shape).all(1)


def cosines(views: Views, view: int, rays: Rays) -> Float[Tensor, " r"]:
    """Ratio of depth along a view's axis to distance along its rays."""
    return -(rays.directions * views.c2w[view, :, 2]).sum(1)


def normalised(patches: Float[Tensor, "*m p"]) -> Float[Tensor, "*m p"]:
    """Patches without their mean, of length 1."""
    centred = patches - patches.mean(-1, keepdim=True)
    return centred / centred.norm(dim=-1, keepdim=True).clamp_min(1e-9)
