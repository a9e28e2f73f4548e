"""Where along the rays a field is evaluated."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ctm_plugin.rays.cameras import Rays


def intersect_box(
    rays: Rays, box: Float[Tensor, "2 3"], near: float, far: float
) -> tuple[Float[Tensor, " r"], Float[Tensor, " r"]]:
    """Distances at which rays enter and leave a box (slab method), cut to [near, far].

    Rays that miss it get ``leave <= enter``.
    """
    # Of a ray that runs along a face, 0 / 0 must not become NaN.
    inverse = 1.0 / torch.where(rays.directions.abs() < 1e-12, 1e-12, rays.directions)
    first = (box[0] - rays.origins) * inverse
    second = (box[1] - rays.origins) * inverse
    enter = torch.minimum(first, second).amax(-1).clamp(near, far)
    leave = torch.maximum(first, second).amin(-1).clamp(near, far)
    return enter, leave


def march(
    enter: Float[Tensor, " r"], leave: Float[Tensor, " r"], step: float, offset: Float[Tensor, " r"] | float = 0.5
) -> tuple[Float[Tensor, " m"], Int[Tensor, " m"]]:
    """Packed samples at equal distances: ``t = enter + (j + offset) step``, j = 0, 1, ..., while ``t < leave``.

    Args:
        enter, leave: the interval of each ray, as from :func:`intersect_box`.
        step: distance between samples, in scene units.
        offset: shift in steps, in [0, 1); one a ray jitters the samples.

    Returns:
        Distances ``t`` and the ray of each sample, sorted by ray, then distance.
    """
    counts = torch.ceil((leave - enter) / step - offset).clamp_min(0).long()
    ray = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    index = torch.arange(len(ray), device=ray.device) - (counts.cumsum(0) - counts)[ray]
    first = enter + offset * step
    return first[ray] + index * step, ray
