"""Splats beside OpenSplat's rasteriser for CPUs: the same Gaussians, pinhole and background, in turns.

``python benchmarks/splat_peer.py PEER [--native] [--most 50000] [--times 9]``

PEER is a checkout of https://github.com/pierotofy/OpenSplat at 15b7e80. Its rasteriser is compiled against torch, with
its own release flags or also, ``--native``, for this processor; a compiler and ninja are needed. Colours are harmonics
of degree 0. With ``NUMBA_DISABLE_JIT=1`` ours is plain torch, which takes seconds beyond ``--most 1000``.
One thread is timed by the process' own clock, in which other work does not count, two by the wall's.

The peer cuts Gaussians 2 pixels beyond 3 standard deviations, ours where alpha falls below 1/255; its largest alpha is
0.999, ours 0.99. It reads depths as if they lay side by side, which they do not: they are laid so here, else it sorts
by other numbers. Its gradient of a conic's xy is half the derivative, so that those of scales and turns differ.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from splats import milliseconds, spread
from torch import Tensor
from torch.utils.cpp_extension import load_inline

from ctm_plugin.metrics.image import psnr
from ctm_plugin.splats.gaussians import Camera, Gaussians
from ctm_plugin.splats.render import picture

SIZES = ((250, 187, 1_000), (250, 187, 10_000), (500, 375, 10_000), (500, 375, 50_000))
NEAR, FAR = 1e-3, 1e3
"""The peer's own; depths so far from its near plane are equal in float32 where they nearly are."""
CALLS = """
#include "project_gaussians.cpp"
#include "rasterize_gaussians.cpp"
#include "spherical_harmonics.cpp"
#include "rasterizer/gsplat-cpu/gsplat_cpu.cpp"

torch::Tensor view(torch::Tensor means, torch::Tensor scales, torch::Tensor turns, torch::Tensor opacities,
                   torch::Tensor base, torch::Tensor directions, torch::Tensor pose, torch::Tensor frustum,
                   std::vector<double> lens, int64_t height, int64_t width, torch::Tensor background) {
    auto p = ProjectGaussiansCPU::apply(means, scales, 1, turns, pose, frustum, lens[0], lens[1], lens[2], lens[3],
                                        height, width);
    auto colors = torch::clamp_min(SphericalHarmonicsCPU::apply(0, directions, base) + 0.5f, 0.0f);
    return RasterizeGaussiansCPU::apply(p[0], p[1], p[2], colors, opacities, p[3], p[4].contiguous(), height, width,
                                        background);
}
"""


def compiled(peer: Path, native: bool) -> Callable[..., Tensor]:
    """The peer's rasteriser, called as its model calls it."""
    flags = ["-O3", "-DNDEBUG", *["-march=native"] * native]
    folders = [str(peer), str(peer / "rasterizer")]
    name = "opensplat_native" if native else "opensplat"
    return load_inline(name, CALLS, functions="view", extra_cflags=flags, extra_include_paths=folders).view


def theirs(view: Callable[..., Tensor], gaussians: Gaussians, camera: Camera, background: Tensor) -> Tensor:
    """The peer's picture ``[H, W, 3]``, from the same tables; its gradient has to lie in memory so."""
    pose, frustum = torch.eye(4), torch.zeros(4, 4)
    pose[:3, :3], pose[:3, 3] = camera.turn, -camera.turn @ camera.centre
    frustum[0, 0], frustum[1, 1] = 2 * camera.lens[0] / camera.width, 2 * camera.lens[1] / camera.height
    frustum[2, 2], frustum[2, 3] = (FAR + NEAR) / (FAR - NEAR), -FAR * NEAR / (FAR - NEAR)
    frustum[3, 2] = 1
    directions = gaussians.means.detach() - camera.centre
    return view(
        gaussians.means, gaussians.scales.exp(), gaussians.quats / gaussians.quats.norm(dim=-1, keepdim=True),
        gaussians.opacities.sigmoid(), gaussians.sh0[:, None], directions / directions.norm(dim=-1, keepdim=True),
        pose, frustum @ pose, camera.lens.tolist(), camera.height, camera.width, background,
    )  # fmt: skip


def ours(gaussians: Gaussians, camera: Camera, background: Tensor) -> Tensor:
    """Our picture ``[H, W, 3]``."""
    shift = torch.zeros(len(gaussians.means), 2, requires_grad=True)
    image, left = picture(gaussians, camera, shift, 1, 0.0, 0)
    return (image + left * background[:, None, None]).permute(1, 2, 0)


def back(side: Callable[[], Tensor], target: Tensor) -> None:
    """A picture and the gradients of its mean squared error."""
    (side() - target).square().mean().backward()


def main() -> None:
    """Print a line for each size, number and number of threads."""
    parser = argparse.ArgumentParser()
    parser.add_argument("peer", type=lambda path: Path(path).resolve())
    parser.add_argument("--native", action="store_true", help="compile the peer for this processor")
    parser.add_argument("--most", type=int, default=SIZES[-1][-1], help="Gaussians")
    parser.add_argument("--times", type=int, default=9, help="turns of each")
    args = parser.parse_args()
    view, white = compiled(args.peer, args.native), torch.ones(3)
    for width, height, count in (size for size in SIZES if size[-1] <= args.most):
        gaussians, camera = spread(count, width, height, 1, (0.0,) * 5)
        target, scene = torch.rand(height, width, 3), (gaussians, camera, white)
        sides = {"ours": partial(ours, *scene), "peer": partial(theirs, view, *scene)}
        backs = {name: partial(back, side, target) for name, side in sides.items()}
        with torch.no_grad():
            near = psnr(*(side() for side in sides.values())).item()
        print(f"{width}x{height}, {count} Gaussians: {near:.1f} dB between the pictures")
        for threads, clock in ((1, time.process_time), (2, time.perf_counter)):
            torch.set_num_threads(threads)
            with torch.no_grad():
                views = milliseconds(sides, args.times, clock)
            for what, found in {"view": views, "there and back": milliseconds(backs, args.times, clock)}.items():
                mine, other = found.values()
                told = f"{mine:.1f} ms, the peer {other:.1f}, ratio {other / mine:.2f}"
                print(f"  {threads} threads, {what}: ours {told}", flush=True)


if __name__ == "__main__":
    main()
