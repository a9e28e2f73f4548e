"""Weights of packed samples, ray by ray: :func:`ctm_plugin.rays.volume.volume_weights`."""

from __future__ import annotations

import math

import torch
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from ctm_plugin.cpu.compiled import compiled


class VolumeWeights(torch.autograd.Function):
    """``w_i = T_i (1 - exp(-tau_i))``, ``T_i = exp(-sum_{j<i} tau_j)``, and what light passes all samples of a ray.

    With ``g`` the gradient of w and ``h`` that of ``T_last``, that of ``tau_i`` is
    ``T_{i+1} g_i - sum_{j>i} w_j g_j - T_last h``. Sums are of float64.
    """

    @staticmethod
    def forward(ctx, depth: Tensor, ray: Tensor, rays: int) -> tuple[Tensor, Tensor]:
        depth, starts = depth.contiguous(), torch.searchsorted(ray, torch.arange(rays + 1))
        if len(depth) != len(ray) or starts[0] != 0 or starts[-1] != len(ray):
            raise ValueError(f"{len(depth)} depths of samples on rays {ray.tolist()[:3]}... of {rays}")
        weights, passed = torch.empty_like(depth), depth.new_empty(rays)
        _weights(depth, starts, weights, passed)
        ctx.save_for_backward(depth, starts, weights, passed)
        return weights, passed

    @staticmethod
    @once_differentiable
    def backward(ctx, of_weights: Tensor, of_passed: Tensor) -> tuple[Tensor, None, None]:
        depth, starts, weights, passed = ctx.saved_tensors
        of_depth = torch.empty_like(depth)
        _gradient(depth, starts, weights, passed, of_weights.contiguous(), of_passed.contiguous(), of_depth)
        return of_depth, None, None


@compiled("void(f4[::1], i8[::1], f4[::1], f4[::1])")
def _weights(depth, starts, weights, passed):
    for r in prange(len(passed)):
        light = 1.0
        for m in range(starts[r], starts[r + 1]):
            alpha = -math.expm1(-float(depth[m]))
            weights[m] = light * alpha
            light *= 1 - alpha
        passed[r] = light


@compiled("void(f4[::1], i8[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1])")
def _gradient(depth, starts, weights, passed, of_weights, of_passed, of_depth):
    for r in prange(len(passed)):
        behind = float(passed[r]) * of_passed[r]
        for m in range(starts[r], starts[r + 1]):
            behind += float(weights[m]) * of_weights[m]
        light = 1.0
        for m in range(starts[r], starts[r + 1]):
            light *= math.exp(-float(depth[m]))
            behind -= float(weights[m]) * of_weights[m]
            of_depth[m] = light * of_weights[m] - behind
