"""Every kernel, and whole steps, against plain torch on this machine's GPU: ``python benchmarks/kernels.py``.

Rows as in ``docs/evidence/timings.csv``. Times are of calls in a row, the host's part in them; bytes are those that
have to be read and written at least. What steps hand over to the GPU goes to the error stream.
"""

from __future__ import annotations

import csv
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
import torch.nn.functional as F
from launches import profiled

from ctm_plugin import door
from ctm_plugin.backbones.dvgo import DVGO
from ctm_plugin.backbones.ngp import NGP
from ctm_plugin.backbones.occupied import OccupiedBackbone
from ctm_plugin.backbones.settings import DVGOConfig, NGPConfig
from ctm_plugin.optim.grid_adam import step_table
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.grid import VoxelGrid, corners, scattered, weighted
from ctm_plugin.rays.hash_grid import HashGrid, encoded, spread
from ctm_plugin.rays.occupancy import occupied_samples
from ctm_plugin.rays.sampling import intersect_box, sample_counts
from ctm_plugin.rays.volume import volume_weights
from ctm_plugin.scene.views import Scene, Views
from ctm_plugin.splats.render import rasterize

CALLS, TURNS = 10, 7
WARM_UP, STEPS, STEP_TURNS = 150, 30, 8
VOXELS = {"coarse": False, "steps_alone": 1000, "grow": ()}
TRAININGS: dict[str, tuple[type[OccupiedBackbone], Any]] = {
    "DVGO, 1024 rays, 64^3": (DVGO, DVGOConfig(**VOXELS, rays=1024, voxels=64**3)),
    "DVGO, 8192 rays, 160^3": (DVGO, DVGOConfig(**VOXELS, rays=8192, voxels=160**3)),
    "hash grid, 4096 rays": (NGP, NGPConfig()),
}


def cases(device: torch.device, side: int, rays: int, entries: int) -> Iterator[tuple[str, Callable, tuple, float]]:
    """What is done, by which function, with what, and bytes it has to move."""
    torch.manual_seed(0)
    grid = VoxelGrid(torch.tensor([[-1.0] * 3, [1.0] * 3]), (side,) * 3).to(device)
    buffers, count = (grid.aabb[0], grid.scale, grid.last, grid.offsets), grid.count
    origins = 3 * F.normalize(torch.randn(rays, 3), dim=1)
    to = F.normalize(torch.rand(rays, 3) - 0.5 - origins, dim=1)
    bundle, step = Rays(origins.to(device), to.to(device)), 0.5 * grid.voxel
    enter, leave = intersect_box(bundle, grid.aabb, 1.0, 5.0)
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

    def call() -> None:
        found = run(*arguments)
        if isinstance(found, tuple) and found[0].requires_grad:
            torch.autograd.grad(found[0], arguments[0], torch.ones_like(found[0]))

    timed(call, 3)
    return min(timed(call, CALLS) for _ in range(TURNS))


def timed(work: Callable[[], object], times: int) -> float:
    """Milliseconds of doing it once, of so many times in a row."""
    torch.cuda.synchronize()
    start = time.perf_counter()
    for _ in range(times):
        work()
    torch.cuda.synchronize()
    return (time.perf_counter() - start) / times * 1e3


def ball(train: int, side: int) -> Scene:
    """A painted ball of radius 1 from all around, a picture that every view shows."""
    rows, columns = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    waves = torch.sin(columns / 7), torch.cos(rows / 9), 0.6 * torch.sin((rows + columns) / 11)
    inside = (rows - side / 2).hypot(columns - side / 2) < 0.275 * side
    picture = torch.stack([*(128 + 100 * wave for wave in waves), torch.full((side, side), 255.0)], 2)
    picture = (picture * inside[..., None]).to(torch.uint8)

    def views(count: int) -> Views:
        back = F.normalize(torch.randn(count, 3), dim=1)
        right = F.normalize(torch.linalg.cross(torch.tensor([[0.0, 0.0, 1.0]]), back), dim=1)
        c2w = torch.stack([right, torch.linalg.cross(back, right), back, 4 * back], 2)
        lens = torch.tensor([side / 0.7, side / 0.7, side / 2, side / 2])
        names = tuple(map(str, range(count)))
        return Views(picture.repeat(count, 1, 1, 1), c2w, lens.repeat(count, 1), names)

    torch.manual_seed(0)
    return Scene("ball", views(train), views(2), near=2.0, far=6.0, geometry="bounded", background="black")


def training(module: OccupiedBackbone) -> Callable[[], None]:
    """A step of a backbone that knows a shell round the ball's surface as occupied."""
    field, device = module.field, module.device.type
    shell = (field.grid.vertices().norm(dim=1) - 1).abs() < 0.25
    field.occupancy.copy_(shell)
    if isinstance(module, NGP):
        field.allowed.copy_(shell)
        field.occupy(shell)
    optimizers = module.configure_optimizers()

    def step() -> None:
        with torch.autocast(device, torch.bfloat16, enabled=device == "cuda"):
            loss = module.training_step(None, 0)["loss"]
        optimizers.zero_grad()
        loss.backward()
        optimizers.step()

    return step


def sides() -> Iterator[str]:
    """Let kernels run, and then plain torch."""
    yield "kernels"
    with patch.object(door, "may_launch", lambda _: False):
        yield "torch"


def steps_in_turns(step: Callable[[], None]) -> dict[str, float]:
    """Milliseconds of a step with kernels and of one by plain torch, medians of turns."""
    times: dict[str, list[float]] = {"kernels": [], "torch": []}
    for _ in range(WARM_UP):
        step()
    for _ in range(STEP_TURNS):
        for name in sides():
            step()
            times[name].append(timed(step, STEPS))
    return {name: statistics.median(found) for name, found in times.items()}


def rows_of(what: str, kernel: float, plain: float, moved: float | None = None) -> list[tuple[str, str, str, str]]:
    """The rows of one comparison, of milliseconds: name, what, value, unit."""
    rows = [
        ("kernel_kernel", what, f"{kernel:.3g}", "ms"),
        ("kernel_torch", what, f"{plain:.3g}", "ms"),
        ("kernel_ratio", what, f"{plain / kernel:.3g}", "times"),
    ]
    return rows if moved is None else [*rows, ("kernel_moved", what, f"{moved / kernel / 1e6:.3g}", "GB/s")]


def main() -> None:
    if not torch.cuda.is_available():
        sys.exit("benchmarks/kernels.py compares kernels on a GPU, and torch sees none here")
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(command, capture_output=True, text=True).stdout.strip()
    write, device = csv.writer(sys.stdout, lineterminator="\n").writerow, torch.device("cuda")

    def tell(*compared: Any) -> None:
        for row in rows_of(*compared):
            write((*row, torch.cuda.get_device_name(), commit, "python benchmarks/kernels.py"))
        sys.stdout.flush()

    steps = {}
    for what, (backbone, config) in TRAININGS.items():
        steps[what] = training(backbone(config, ball(25, 200)).to(device))
        times = steps_in_turns(steps[what])
        tell(what, times["kernels"], times["torch"])
    for what, function, arguments, moved in cases(device, side=160, rays=8192, entries=1 << 19):
        tell(what, *(milliseconds(run, arguments) for run in (function, function.reference)), moved)
    for what, step in steps.items():
        for name in sides():
            print(f"{what}, {name}:", json.dumps(profiled(step, device), indent=1), file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
