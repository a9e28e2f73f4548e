"""Every kernel against plain torch on this machine's GPU, at the paper's size: ``python benchmarks/kernels.py``.

Rows as in ``docs/evidence/timings.csv``. Times are of calls in a row, the host's part in them; bytes are those that
have to be read and written at least.
"""

from __future__ import annotations

import csv
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
import torch.nn.functional as F

from ctm_plugin.optim.grid_adam import step_table
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.grid import VoxelGrid, corners, scattered, weighted
from ctm_plugin.rays.hash_grid import HashGrid, encoded, spread
from ctm_plugin.rays.occupancy import occupied_samples
from ctm_plugin.rays.sampling import intersect_box, sample_counts
from ctm_plugin.rays.volume import volume_weights
from ctm_plugin.splats.render import rasterize

CALLS, TURNS = 10, 7


def cases(device: torch.device, side: int, rays: int, entries: int) -> Iterator[tuple[str, Callable, tuple, float]]:
    """What is done, by which function, with what, and bytes it has to move."""
    torch.manual_seed(0)
    grid = VoxelGrid(torch.tensor([[-1.0] * 3, [1.0] * 3]), (side,) * 3).to(device)
    buffers, count = (grid.box[0], grid.scale, grid.last, grid.offsets), grid.count
    origins = 3 * F.normalize(torch.randn(rays, 3), dim=1)
    to = F.normalize(torch.rand(rays, 3) - 0.5 - origins, dim=1)
    bundle, step = Rays(origins.to(device), to.to(device)), 0.5 * grid.voxel
    enter, leave = intersect_box(bundle, grid.box, 1.0, 5.0)
    counts = sample_counts(enter, leave, step, 0.5)
    occupied = (grid.vertices().norm(dim=1) - 0.55).abs() < 3 * grid.voxel  # the shell of an object
    of_samples = *bundle, enter + 0.5 * step, counts, step, occupied, *buffers
    _, ray_index, points = occupied_samples.reference(*of_samples)
    m, all_of_them = len(points), int(counts.sum())
    yield f"samples outside free space, {m:,} of {all_of_them:,}", occupied_samples, of_samples, all_of_them + 24 * m
    yield f"corners of {m:,} points", corners, (points, *buffers), 76 * m
    rows, shares = corners.reference(points, *buffers)
    touched = len(rows.unique())
    for c in (1, 12):
        table, grad = torch.randn(count, c, device=device), torch.randn(m, c, device=device)
        yield f"lookups of {c} in {side}^3", weighted, (table, rows, shares), 64 * m + 4 * c * (m + touched)
        of_gradient = rows, shares, grad, table.shape, False
        yield f"their gradient, of {c}", scattered, of_gradient, 64 * m + 4 * c * (m + count + 2 * touched)
        change, moments = scattered.reference(*of_gradient), (torch.zeros_like(table), torch.zeros_like(table))
        of_step = table, change, *moments, None, 3, 0.1, (0.9, 0.99), 1e-8
        yield f"Adam of {side}^3 x {c}, {touched:,} rows", step_table, of_step, 4 * c * (count + 6 * touched)
    depth = (3 * torch.rand(m, device=device) ** 6).requires_grad_()
    yield f"weights of {m:,} samples, and gradient", volume_weights, (depth, ray_index, rays), 44 * m
    hashed = HashGrid(16, 2, entries, 16, 2048).to(device)
    at, table = ((points + 1) / 2, hashed.sides, hashed.starts), hashed.table.detach()
    yield f"{m:,} points in a hash grid", encoded, (table, *at), 140 * m + table.nbytes
    of_spread = torch.randn(m, 32, device=device), *at, table.shape
    yield "their gradient", spread, of_spread, 140 * m + 2 * table.nbytes
    count = side**2
    means, depths, faint = side * torch.rand(count, 2, device=device), *torch.rand(2, count, device=device)
    conics, extents = torch.tensor([[0.1, 0.0, 0.1]], device=device).repeat(count, 1), torch.full_like(means, 10.0)
    of_splats = means, conics, faint, extents, depths, torch.rand(count, 3, device=device), side, side
    yield f"{count:,} Gaussians on {side}x{side}", rasterize, of_splats, 36 * count + 16 * side**2


def milliseconds(run: Callable, arguments: tuple) -> float:
    """The least of several turns, a call, gradients of what wants them with it."""

    def turn(calls: int) -> float:
        torch.cuda.synchronize()
        start = time.perf_counter()
        for _ in range(calls):
            found = run(*arguments)
            if isinstance(found, tuple) and found[0].requires_grad:
                torch.autograd.grad(found[0], arguments[0], torch.ones_like(found[0]))
        torch.cuda.synchronize()
        return (time.perf_counter() - start) / calls * 1e3

    turn(3)
    return min(turn(CALLS) for _ in range(TURNS))


def rows_of(what: str, kernel: float, plain: float, moved: float) -> list[tuple[str, str, str, str]]:
    """The rows of one comparison, of milliseconds: name, what, value, unit."""
    return [
        ("kernel_kernel", what, f"{kernel:.3g}", "ms"),
        ("kernel_torch", what, f"{plain:.3g}", "ms"),
        ("kernel_ratio", what, f"{plain / kernel:.3g}", ""),
        ("kernel_moved", what, f"{moved / kernel / 1e6:.3g}", "GB/s"),
    ]


def main() -> None:
    if not torch.cuda.is_available():
        sys.exit("benchmarks/kernels.py compares kernels on a GPU, and torch sees none here")
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(command, capture_output=True, text=True).stdout.strip()
    write = csv.writer(sys.stdout, lineterminator="\n").writerow
    for what, function, arguments, moved in cases(torch.device("cuda"), side=160, rays=8192, entries=1 << 19):
        kernel, plain = (milliseconds(run, arguments) for run in (function, function.reference))
        for row in rows_of(what, kernel, plain, moved):
            write((*row, torch.cuda.get_device_name(), commit, "python benchmarks/kernels.py"))


if __name__ == "__main__":
    main()
