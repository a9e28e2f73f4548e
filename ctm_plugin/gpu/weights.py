"""Kernel of packed samples' rendering weights, one program a ray: :func:`ctm_plugin.rays.volume.volume_weights`."""

from __future__ import annotations

import torch
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from ctm_plugin.gpu.kernels import kernel, launch, whole

SAMPLE_BLOCK = 64
"""Samples that one program of the kernel holds at once."""


class VolumeWeights(torch.autograd.Function):
    """Volume rendering weights, as :class:`ctm_plugin.cpu.weights.VolumeWeights`; sums are of float64."""

    @staticmethod
    def forward(ctx, optical_depth: Tensor, ray_index: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
        depth, ray_index = whole(optical_depth.detach(), ray_index)
        starts = torch.searchsorted(ray_index, torch.arange(n_rays + 1, device=ray_index.device))
        weights, transmittance = torch.empty_like(depth), depth.new_empty(n_rays)
        launch(_weights, (n_rays,), depth, starts, weights, transmittance, BLOCK=SAMPLE_BLOCK, num_warps=1)
        ctx.save_for_backward(depth, starts, weights)
        return weights, transmittance

    @staticmethod
    @once_differentiable
    def backward(ctx, of_weights: Tensor, of_transmittance: Tensor) -> tuple[Tensor, None, None]:
        depth, starts, weights = ctx.saved_tensors
        of_depth, given = torch.empty_like(depth), whole(of_weights, of_transmittance)
        launch(_gradient, (len(starts) - 1,), depth, starts, weights, *given, of_depth, BLOCK=SAMPLE_BLOCK, num_warps=1)
        return of_depth, None, None


@kernel
def _alpha(depth):
    """Alpha of an optical depth, ``1 - exp(-depth)``, by its series where the difference would have few digits."""
    series = 1 - depth / 4 * (1 - depth / 5 * (1 - depth / 6 * (1 - depth / 7)))
    series = depth * (1 - depth / 2 * (1 - depth / 3 * series))
    return tl.where(depth < 0.25, series, 1 - tl.exp(-depth))


@kernel
def _solid(depth):
    """Optical depth cut for summation: nothing passes exp(-100), and larger depths would drown their neighbours."""
    return tl.where(depth > 100.0, 100.0, depth).to(tl.float64)


@kernel
def _weights(depths, starts, weights, transmittance, BLOCK: tl.constexpr):
    ray, lane = tl.program_id(0), tl.arange(0, BLOCK)
    start, end = tl.load(starts + ray), tl.load(starts + ray + 1)
    passed = start.to(tl.float64) * 0
    for begin in range(start, end, BLOCK):
        m = begin + lane
        depth = tl.load(depths + m, mask=m < end, other=0.0)
        solid = _solid(depth)
        before = passed + tl.cumsum(solid, 0) - solid
        tl.store(weights + m, tl.exp(-before).to(tl.float32) * _alpha(depth), mask=m < end)
        passed += tl.sum(solid, 0)
    tl.store(transmittance + ray, tl.exp(-passed).to(tl.float32))


@kernel
def _gradient(depths, starts, weights, of_weights, of_transmittance, of_depth, BLOCK: tl.constexpr):
    ray, lane = tl.program_id(0), tl.arange(0, BLOCK)
    start, end = tl.load(starts + ray), tl.load(starts + ray + 1)
    # In float64, differences too: what light passes on and what lies behind are nearly the same where all is thin.
    passed = start.to(tl.float64) * 0
    behind = passed
    for begin in range(start, end, BLOCK):
        m = begin + lane
        weight = tl.load(weights + m, mask=m < end, other=0.0).to(tl.float64)
        behind += tl.sum(weight * tl.load(of_weights + m, mask=m < end, other=0.0), 0)
        passed += tl.sum(_solid(tl.load(depths + m, mask=m < end, other=0.0)), 0)
    behind += tl.exp(-passed) * tl.load(of_transmittance + ray)
    passed *= 0
    for begin in range(start, end, BLOCK):
        m = begin + lane
        solid = _solid(tl.load(depths + m, mask=m < end, other=0.0))
        change = tl.load(of_weights + m, mask=m < end, other=0.0)
        part = tl.load(weights + m, mask=m < end, other=0.0).to(tl.float64) * change
        left = tl.exp(-(passed + tl.cumsum(solid, 0)))
        tl.store(of_depth + m, (left * change - (behind - tl.cumsum(part, 0))).to(tl.float32), mask=m < end)
        passed += tl.sum(solid, 0)
        behind -= tl.sum(part, 0)
