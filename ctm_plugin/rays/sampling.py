"""Distances along rays at which a field is evaluated."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ctm_plugin.rays.cameras import Rays


def intersect_box(
    rays: Rays, box: Float[Tensor, "2 3"], near: float, far: float
) -> tuple[Float[Tensor, " r"], Float[Tensor, " r"]]:
    """Find distances at which rays enter and leave a box (slab method), cut to [near, far].

    Rays that miss it get ``leave <= enter``.
    """
    # Of a ray that runs along a face, 0 / 0 must not become NaN.
    inverse = 1.0 / torch.where(rays.directions.abs() < 1e-12, 1e-12, rays.directions)
    first = (box[0] - rays.origins) * inverse
    second = (box[1] - rays.origins) * inverse
    enter = torch.minimum(first, second).amax(-1).clamp(near, far)
    leave = torch.maximum(first, second).amin(-1).clamp(near, far)
    return enter, leave


def stratified(
    n_rays: int, count: int, jitter: Float[Tensor, "r n"] | None = None, device: torch.device | str = "cpu"
) -> Float[Tensor, "r n"]:
    """Place one sample in each of ``count`` equal parts of [0, 1]: ``s_j = (j + jitter_j) / count``.

    Args:
        jitter: in [0, 1); ``None``: the middle of each part.
    """
    parts = torch.arange(count, device=device)
    return ((parts + 0.5) if jitter is None else (parts + jitter)).div(count).expand(n_rays, count)


def importance(
    edges: Float[Tensor, "r b1"], weights: Float[Tensor, "r b"], u: Float[Tensor, "r n"]
) -> Float[Tensor, "r n"]:
    """Invert the cumulative distribution of a density that is constant between edges.

    With ``p_i = (weights_i + eps) / sum`` and ``P_i = sum_{j<i} p_j``: for ``P_i <= u < P_{i+1}``,
    ``t = edges_i + (edges_{i+1} - edges_i) (u - P_i) / p_i``. The eps of 1e-5 gives a ray that met nothing a density
    all the same: a uniform one if the bins are equal (Mildenhall et al., ECCV 2020, section 5.2).

    Args:
        edges: B + 1 a ray, ascending.
        weights: of the B bins, >= 0.
        u: in [0, 1]; ascending numbers give ascending samples.
    """
    share = weights + 1e-5
    share = share / share.sum(-1, keepdim=True)
    upper = share.cumsum(-1)
    # The sums end near 1: u beyond the last one belongs to the last bin.
    index = torch.searchsorted(upper, u.contiguous(), right=True).clamp_max(weights.shape[1] - 1)
    width = share.gather(1, index)
    into = ((u - (upper.gather(1, index) - width)) / width).clamp(0, 1)
    return edges[:, :-1].gather(1, index).lerp(edges[:, 1:].gather(1, index), into)


def march(
    enter: Float[Tensor, " r"], leave: Float[Tensor, " r"], step: float, offset: Float[Tensor, " r"] | float = 0.5
) -> tuple[Float[Tensor, " m"], Int[Tensor, " m"]]:
    """Pack samples at equal distances: ``t = enter + (j + offset) step``, j = 0, 1, ..., while ``t < leave``.

    Args:
        enter, leave: the interval of each ray, as from :func:`intersect_box`.
        step: distance between samples, in scene units.
        offset: shift in steps, in [0, 1); one a ray jitters the samples.

    Returns:
        Distances ``t`` and the ray of each sample, sorted by ray, then distance.
    """
    return pack_samples(enter + offset * step, sample_counts(enter, leave, step, offset), step)


def pack_samples(
    first: Float[Tensor, " r"], counts: Int[Tensor, " r"], step: float
) -> tuple[Float[Tensor, " m"], Int[Tensor, " m"]]:
    """Place ``counts`` samples on each ray at ``first + j step``, packed; give their distances and ray indices."""
    ends = counts.cumsum(0)
    total = int(ends[-1]) if len(ends) else 0  # a GPU is waited for once; not knowing it, torch waits twice
    ray_index = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts, output_size=total)
    index = torch.arange(total, device=ray_index.device) - (ends - counts)[ray_index]
    return first[ray_index] + index * step, ray_index


def sample_counts(
    enter: Float[Tensor, " r"], leave: Float[Tensor, " r"], step: float, offset: Float[Tensor, " r"] | float
) -> Int[Tensor, " r"]:
    """Count the samples that :func:`march` takes on each ray."""
    return torch.ceil((leave - enter) / step - offset).clamp_min(0).long()
