"""Kernel of samples outside free space, one program a ray: :func:`ctm_plugin.rays.occupancy.occupied_samples`."""

from __future__ import annotations

import triton.language as tl
from torch import Tensor

from ctm_plugin.gpu.kernels import kernel, launch, whole
from ctm_plugin.gpu.lookup import place

SAMPLE_BLOCK = 64
"""Samples that one program of the kernel holds at once."""


def occupied_samples(
    origins: Tensor, directions: Tensor, first: Tensor, counts: Tensor, step: float, occupancy: Tensor,
    low: Tensor, scale: Tensor, last: Tensor, offsets: Tensor, contracted: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Find samples in occupied cells (:func:`ctm_plugin.rays.occupancy.occupied_samples`): counted, then written.

    The host waits for the GPU once, for the number of samples.
    """
    given = *whole(origins, directions, first, counts, occupancy, low, scale, last), step
    kept, sizes = counts.new_empty(len(counts)), {"CONTRACTED": contracted, "BLOCK": SAMPLE_BLOCK, "num_warps": 2}
    launch(_find, (len(counts),), *given, kept, kept, first, kept, first, 0, FILL=False, **sizes)
    ends = kept.cumsum(0)
    total = int(ends[-1]) if len(ends) else 0
    t, ray, points = first.new_empty(total), counts.new_empty(total), first.new_empty(3, total)
    launch(_find, (len(counts),), *given, kept, ends, t, ray, points, total, FILL=True, **sizes)
    return t, ray, points.T


@kernel
def _nearest(x, low, scale, last):
    """Nearest vertex to a coordinate: adding and subtracting 2^23 rounds to whole numbers, halves to even ones."""
    at = place(x, tl.load(low), tl.load(scale), tl.load(last))
    return tl.where(at > 0, at + 8388608.0 - 8388608.0, 0.0).to(tl.int64)


@kernel
def _find(
    origins, directions, first, counts, occupancy, low, scale, last, step, kept, ends, ts, rays, points, across,
    FILL: tl.constexpr, CONTRACTED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Count a ray's samples in occupied cells; ``FILL``: write them, so that they end where ``ends`` says, of
    ``across`` in all."""
    ray, lane = tl.program_id(0).to(tl.int64), tl.arange(0, BLOCK)
    count, start = tl.load(counts + ray), tl.load(first + ray)
    ray_x, to_x = tl.load(origins + 3 * ray), tl.load(directions + 3 * ray)
    ray_y, to_y = tl.load(origins + 3 * ray + 1), tl.load(directions + 3 * ray + 1)
    ray_z, to_z = tl.load(origins + 3 * ray + 2), tl.load(directions + 3 * ray + 2)
    of_y, of_z = (tl.load(last + 1) + 1).to(tl.int64), (tl.load(last + 2) + 1).to(tl.int64)
    end = tl.load(ends + ray) if FILL else ray * 0
    at = end - tl.load(kept + ray) if FILL else end
    for begin in range(0, count, BLOCK):
        t = start + (begin + lane).to(tl.float32) * step
        far = tl.where(t <= 2.0, t, 4.0 / (4.0 - t)) if CONTRACTED else t  # as rays/contraction.py
        x, y, z = ray_x + to_x * far, ray_y + to_y * far, ray_z + to_z * far
        if CONTRACTED:
            norm = tl.maximum(tl.sqrt(x * x + y * y + z * z), 1.0)
            factor = (2.0 - 1.0 / norm) / norm
            x, y, z = x * factor, y * factor, z * factor
        row = _nearest(x, low, scale, last) * of_y + _nearest(y, low + 1, scale + 1, last + 1)
        row = row * of_z + _nearest(z, low + 2, scale + 2, last + 2)
        hit = tl.load(occupancy + row, mask=begin + lane < count, other=0).to(tl.int32)
        if FILL:
            to = at + tl.cumsum(hit, 0) - 1
            here = (hit != 0) & (to < end)
            tl.store(ts + to, t, mask=here)
            tl.store(rays + to, ray + lane * 0, mask=here)
            tl.store(points + to, x, mask=here)
            tl.store(points + across + to, y, mask=here)
            tl.store(points + tl.cast(across, tl.int64) * 2 + to, z, mask=here)
        at += tl.sum(hit, 0)
    if not FILL:
        tl.store(kept + ray, at)
