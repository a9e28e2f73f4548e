"""Loop of volume rendering weights of packed samples, ray by ray: :func:`ctm_plugin.rays.volume.volume_weights`."""

from __future__ import annotations

import math

import torch
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from ctm_plugin.cpu.compiled import compiled


class VolumeWeights(torch.autograd.Function):
    """Weights ``w_i = T_i (1 - exp(-tau_i))``, ``T_i = exp(-sum_{j<i} tau_j)``, and the transmittance of a ray.

    With ``g`` the gradient of w and ``h`` that of ``T_last``, that of ``tau_i`` is
    ``T_{i+1} g_i - sum_{j>i} w_j g_j - T_last h``. Sums are of float64.
    """

    @staticmethod
    def forward(ctx, optical_depth: Tensor, ray_index: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
        optical_depth, starts = optical_depth.contiguous(), torch.searchsorted(ray_index, torch.arange(n_rays + 1))
        if len(optical_depth) != len(ray_index) or starts[0] != 0 or starts[-1] != len(ray_index):
            raise ValueError(f"{len(optical_depth)} depths of samples on rays {ray_index.tolist()[:3]}... of {n_rays}")
        weights, transmittance = torch.empty_like(optical_depth), optical_depth.new_empty(n_rays)
        _weights(optical_depth, starts, weights, transmittance)
        ctx.save_for_backward(optical_depth, starts, weights, transmittance)
        return weights, transmittance

    @staticmethod
    @once_differentiable
    def backward(ctx, of_weights: Tensor, of_transmittance: Tensor) -> tuple[Tensor, None, None]:
        optical_depth, starts, weights, transmittance = ctx.saved_tensors
        of_optical_depth = torch.empty_like(optical_depth)
        given = of_weights.contiguous(), of_transmittance.contiguous()
        _gradient(optical_depth, starts, weights, transmittance, *given, of_optical_depth)
        return of_optical_depth, None, None


@compiled("void(f4[::1], i8[::1], f4[::1], f4[::1])")
def _weights(optical_depth, starts, weights, transmittance):
    for r in prange(len(transmittance)):
        light = 1.0
        for m in range(starts[r], starts[r + 1]):
            alpha = -math.expm1(-float(optical_depth[m]))
            weights[m] = light * alpha
            light *= 1 - alpha
        transmittance[r] = light


@compiled("void(f4[::1], i8[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1])")
def _gradient(optical_depth, starts, weights, transmittance, of_weights, of_transmittance, of_optical_depth):
    for r in prange(len(transmittance)):
        behind = float(transmittance[r]) * of_transmittance[r]
        for m in range(starts[r], starts[r + 1]):
            behind += float(weights[m]) * of_weights[m]
        light = 1.0
        for m in range(starts[r], starts[r + 1]):
            light *= math.exp(-float(optical_depth[m]))
            behind -= float(weights[m]) * of_weights[m]
            of_optical_depth[m] = light * of_weights[m] - behind
