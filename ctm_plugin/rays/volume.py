"""Volume rendering of packed samples and of tables of samples.

*Packed*: the samples of all rays stand in one row, sorted by ray, then by distance; ``ray_index`` ``[M]`` says on which
ray each lies. Rays have as many as they need, none included. A *table* ``[R, S]`` has equally many for each ray.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ctm_plugin.door import looped


def ray_starts(ray_index: Int[Tensor, " m"], n_rays: int) -> Int[Tensor, " r"]:
    """Find each ray's first sample: ``starts[i] = #{j: ray_index[j] < i}``, M for rays after the last sample."""
    return torch.searchsorted(ray_index, torch.arange(n_rays, device=ray_index.device))


def segment_sums(values: Float[Tensor, " m *c"], ray_index: Int[Tensor, " m"], n_rays: int) -> Float[Tensor, " r *c"]:
    """Add up ``out[i] = sum of values[j] over ray_index[j] = i``; 0 for rays without samples."""
    return values.new_zeros(n_rays, *values.shape[1:]).index_add_(0, ray_index, values)


@looped("weights:VolumeWeights.apply", kernel="weights:VolumeWeights.apply")
def volume_weights(
    optical_depth: Float[Tensor, " m"], ray_index: Int[Tensor, " m"], n_rays: int
) -> tuple[Float[Tensor, " m"], Float[Tensor, " r"]]:
    """Weigh packed samples, and find the transmittance of each ray as a whole.

    With optical depths ``tau_i = sigma_i delta_i``: ``T_i = exp(-sum_{j<i} tau_j)``, ``w_i = T_i (1 - exp(-tau_i))``,
    ``T_last = exp(-sum_j tau_j)``, so that ``sum_i w_i + T_last = 1`` on every ray (paper, Eq. 1 and 2).

    Args:
        optical_depth: of each sample, >= 0.
        ray_index: ascending.
        n_rays: R.

    Returns:
        ``w`` ``[M]`` and ``T_last`` ``[R]``, in [0, 1].
    """
    if not len(ray_index):
        return optical_depth, optical_depth.new_ones(n_rays)
    # One running sum over all rays: float64 keeps the differences exact to float32 however long the row is, and
    # opaque samples (nothing passes exp(-100)) do not drown what follows them.
    solid = optical_depth.clamp(max=100.0).double()
    before = solid.cumsum(0) - solid
    starts = ray_starts(ray_index, n_rays)
    offset = before[starts.clamp(max=len(ray_index) - 1)]
    transmittance = torch.exp(offset[ray_index] - before).to(optical_depth.dtype)
    weights = transmittance * -torch.expm1(-optical_depth)
    return weights, torch.exp(-segment_sums(optical_depth, ray_index, n_rays))


def distortion(
    weights: Float[Tensor, " m"], s: Float[Tensor, " m"], ray_index: Int[Tensor, " m"], n_rays: int, interval: float
) -> Float[Tensor, ""]:
    """Measure how far apart the weights of a ray lie, the mean over rays, in time linear in the samples.

    ``sum_ij w_i w_j |s_i - s_j| + 1/3 sum_i w_i^2 interval`` (Barron et al., CVPR 2022, eq. 15), the double sum as
    ``2 sum_i w_i (s_i W_i - V_i)`` with ``W_i = sum_{j<i} w_j``, ``V_i = sum_{j<i} w_j s_j``.

    Args:
        weights, s: of packed samples; ``s`` in [0, 1], ascending on each ray.
        ray_index: ascending.
        n_rays: R, those without samples included.
        interval: length of a sample in ``s``.
    """
    if not len(ray_index):
        return weights.sum()
    # In float64, as in volume_weights; a ray's own sums are those of the whole row less what stands before the ray.
    mass, moment = weights.double(), (weights * s).double()
    first = ray_starts(ray_index, n_rays).clamp(max=len(ray_index) - 1)[ray_index]
    mass_before, moment_before = mass.cumsum(0) - mass, moment.cumsum(0) - moment
    mass_before, moment_before = mass_before - mass_before[first], moment_before - moment_before[first]
    apart = 2 * mass * (s * mass_before - moment_before) + mass.square() * (interval / 3)
    return (apart.sum() / n_rays).to(weights.dtype)


def occlusion(weights: Float[Tensor, " m"], s: Float[Tensor, " m"], n_rays: int) -> Float[Tensor, ""]:
    """Measure how much of what rays see lies close before their cameras, the mean over rays.

    ``sum_i w_i max(0, 1 - 2 s_i)^2``. What is there is one camera's own, and no other contradicts it. After the
    occlusion loss of FreeNeRF (Yang et al., CVPR 2023), the mean density of the first samples; this one fades away.

    Args:
        weights, s: of packed samples; ``s`` in [0, 1], the share of the way from near to far.
        n_rays: R, those without samples included.
    """
    return (weights * (1 - 2 * s).clamp_min(0).square()).sum() / n_rays


def table_weights(optical_depth: Float[Tensor, "r s"]) -> tuple[Float[Tensor, "r s"], Float[Tensor, " r"]]:
    """Weigh a table of samples, and find each ray's transmittance, by the formulas of :func:`volume_weights`.

    Args:
        optical_depth: of each sample, >= 0, samples of a ray in order.

    Returns:
        ``w`` ``[R, S]`` and ``T_last`` ``[R]``, in [0, 1].
    """
    through = optical_depth.cumsum(-1)
    # Shifted rather than `through - depth`: one opaque sample would swallow the digits of all before it.
    before = torch.cat([torch.zeros_like(optical_depth[:, :1]), through[:, :-1]], dim=-1)
    return torch.exp(-before) * -torch.expm1(-optical_depth), torch.exp(-through[:, -1])
