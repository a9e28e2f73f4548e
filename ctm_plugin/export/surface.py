"""Surface of a field: a cloud of points that its training views see, or a mesh."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from skimage.measure import marching_cubes
from torch import Tensor

from ctm_plugin.backbones.posed import PosedBackbone
from ctm_plugin.errors import CTMError
from ctm_plugin.metrics.precision import full_float32
from ctm_plugin.show.bars import tracked

LAYER_THICKNESS = 0.01
"""Thickness of the layer that makes a mesh's surface opaque, as a share of the box's longest side."""
POINTS = 1 << 15
"""Points that a field is evaluated at in one go."""
MAX_DEPTH_STEP = 0.1
"""Largest relative difference of neighbouring pixels' depths on one surface."""
NORMAL_OFFSET = 1e-3
"""Half the distance of the differences that a cloud's normals are made of, as a share of the distance to the camera."""


class Surface(NamedTuple):
    """Points of a surface, in the scene's world, on the CPU.

    Attributes:
        points, normals: ``[P, 3]``; normals have unit length and point out of matter.
        colors: ``[P, 3]`` sRGB in [0, 1].
        faces: ``[F, 3]``, counter-clockwise from outside; ``None``: a cloud.
    """

    points: Float[Tensor, "p 3"]
    normals: Float[Tensor, "p 3"]
    colors: Float[Tensor, "p 3"]
    faces: Int[Tensor, "f 3"] | None = None


def stopped(module: PosedBackbone, points: Float[Tensor, "m 3"], length: Tensor | float) -> Float[Tensor, " m"]:
    """Opacity ``[M]`` of a length of what lies at points ``[M, 3]``: ``1 - exp(-density length)``."""
    axis = torch.tensor([0.0, 0.0, -1.0], device=points.device).expand_as(points)
    density = torch.cat([module.query(*part)[0] for part in zip(points.split(POINTS), axis.split(POINTS), strict=True)])
    return -torch.expm1(-density * length)


def normals(module: PosedBackbone, points: Float[Tensor, "m 3"], half: Tensor | float) -> Float[Tensor, "m 3"]:
    """Against the density's gradient at points ``[M, 3]``, by central differences over twice ``half``; 0 without one.

    The gradient is of :func:`stopped`, whose direction is the density's.
    """
    length = torch.as_tensor(half, device=points.device).expand(len(points))
    steps = torch.eye(3, device=points.device)
    slopes = [
        stopped(module, points + length[:, None] * step, length)
        - stopped(module, points - length[:, None] * step, length)
        for step in steps
    ]
    return -F.normalize(torch.stack(slopes, dim=1), dim=1)


def spanned(points: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Normals, of either sign, of the surface through a picture's neighbouring points; 0 without neighbours."""
    around = F.pad(points.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="replicate")[0]
    across, down = around[:, 1:-1, 2:] - around[:, 1:-1, :-2], around[:, 2:, 1:-1] - around[:, :-2, 1:-1]
    return F.normalize(torch.linalg.cross(across, down, dim=0), dim=0).permute(1, 2, 0)


@torch.no_grad()
def cloud(module: PosedBackbone, max_points: int, opaque: float) -> Surface:
    """Cloud of the points where the training views' rays end, with the colours rendered there.

    Normals are the density's gradient where the backbone gives densities, else those of neighbouring end points.

    Args:
        module: the backbone with trained weights.
        max_points: most points over all views, which are thinned evenly.
        opaque: share of a ray's light that matter must stop.

    Raises:
        CTMError: no ray meets such matter.
    """
    scene, views, tells = module.scene, module.scene.train, type(module).query is not PosedBackbone.query
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
            if tells:
                normal = normals(module, points, NORMAL_OFFSET * along.flatten()[keep])
            facing = (normal * directions).sum(1, keepdim=True)
            # What is seen faces the camera; where there is no gradient, straight.
            normal = torch.where(facing == 0, -directions, -normal * facing.sign())
            parts.append((points, normal, view["rgb"].flatten(0, 1)[keep]))
    points, normal, colors = (torch.cat(part).float().cpu() for part in zip(*parts, strict=True))
    if not len(points):
        raise CTMError(f"no ray of the training views stops {opaque:g} of its light; a lower opaque finds more")
    return Surface(points, normal, colors.clamp(0, 1))


@torch.no_grad()
def mesh(module: PosedBackbone, cells: int, opaque: float) -> Surface:
    """Marching cubes round what stops light (Lorensen and Cline, SIGGRAPH 1987), closed where its box ends.

    Args:
        module: with its weights.
        cells: along the longest side of the box.
        opaque: share of the light that what lies on the surface would stop if it were ``LAYER_THICKNESS`` thick.

    Raises:
        CTMError: there is no such surface, or the backbone does not tell densities.
    """
    low, high = module.world_box().to(module.device)
    longest = float((high - low).max())
    side, layer = longest / cells, LAYER_THICKNESS * longest
    counts = [max(2, math.ceil(length / side - 1e-6) + 1) for length in (high - low).tolist()]
    x, y, z = (start + side * torch.arange(n, device=module.device) for start, n in zip(low, counts, strict=True))
    with full_float32(module.device):
        layers = []
        for each in tracked(x, "layers"):
            points = torch.stack(torch.meshgrid(each[None], y, z, indexing="ij"), dim=-1).view(-1, 3)
            layers.append(stopped(module, points, layer).view(len(y), len(z)).cpu())
        volume = F.pad(torch.stack(layers), (1, 1, 1, 1, 1, 1))
        if not volume.max() > opaque:
            found = f"{layer:.3g} of what is densest stops {float(volume.max()):.2g} of the light"
            raise CTMError(f"no surface at opaque={opaque:g}: {found}; a lower one finds some")
        vertices, faces, _, _ = marching_cubes(
            volume.numpy(), opaque, spacing=(side,) * 3, gradient_direction="ascent", allow_degenerate=False
        )
        points = torch.from_numpy(vertices.copy()).float().to(module.device) + low - side
        normal = normals(module, points, side / 2)
        parts = zip(points.split(POINTS), normal.split(POINTS), strict=True)
        colors = torch.cat([module.decode(module.query(at, -out)[1].float()) for at, out in parts])
    return Surface(
        points.cpu(), normal.cpu(), colors.float().cpu().clamp(0, 1), torch.from_numpy(faces.astype("int32"))
    )
