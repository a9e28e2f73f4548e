"""Choices in the step, each against its alternative: ``OMP_NUM_THREADS=1 python benchmarks/primitives.py``."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
import torch.nn.functional as F
from torch.optim.adam import adam

from ctm_plugin import door
from ctm_plugin.backbones.networks import ViewMLP
from ctm_plugin.backbones.spaces import Box
from ctm_plugin.backbones.voxels import VoxelField
from ctm_plugin.cpu.allocator import keep_memory
from ctm_plugin.cpu.products import fast_products
from ctm_plugin.optim.grid_adam import GridAdam
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.encoding import embed
from ctm_plugin.rays.grid import VoxelGrid, lookup, scattered
from ctm_plugin.rays.volume import volume_weights


def median_ms(run: Callable[[], object], repeats: int = 9) -> float:
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return statistics.median(times) * 1e3


def compare(what: str, loop: Callable[[], object], plain: Callable[[], object]) -> None:
    print(f"{what}: {median_ms(loop):.2f} ms, by torch alone {median_ms(plain):.2f} ms")


def by_torch(table: torch.nn.Parameter, optimizer: GridAdam) -> Callable[[], None]:
    """A step with the table's sparse gradient: rows gathered, torch's fused Adam, rows put back."""
    rows, grad = table.grad._indices()[0], table.grad._values()
    optimizer.step()
    tables = (table.detach(), *(optimizer.state[table][name] for name in ("exp_avg", "exp_avg_sq")))

    def step() -> None:
        part = [each.index_select(0, rows) for each in tables]
        adam(
            [part[0]], [grad], [part[1]], [part[2]], [], [torch.tensor(1.0)], fused=True, amsgrad=False, beta1=0.9,
            beta2=0.99, lr=0.1, weight_decay=0.0, eps=1e-8, maximize=False,
        )  # fmt: skip
        for into, values in zip(tables, part, strict=True):
            into.index_copy_(0, rows, values)

    return step


def by_torch_alone(function: Callable, *arguments: Any) -> Callable[[], Any]:
    """The function without the loops inside it."""

    def run() -> Any:
        with patch.object(door, "may_run", lambda _: False):
            return function(*arguments)

    return run


def main() -> None:
    keep_memory()
    torch.manual_seed(0)
    grid = VoxelGrid(torch.tensor([[-1.0] * 3, [1.0] * 3]), (64, 64, 64))
    rows = grid.corners(torch.rand(150_000, 3) * 2 - 1).rows.flatten()
    values = torch.randn(len(rows), 3)
    for index in (rows, rows.long()):
        spent = median_ms(lambda index=index: torch.zeros(grid.count, 3).index_add_(0, index, values))
        print(f"scatter of {len(rows):,} x 3 into 64^3, {index.dtype}: {spent:.1f} ms")

    for side in (64, 160):
        grid = VoxelGrid(torch.tensor([[-1.0] * 3, [1.0] * 3]), (side,) * 3)
        along = torch.arange(50) / side  # 50 samples on each of 1024 rays, two a voxel
        directions = F.normalize(torch.randn(1024, 1, 3), dim=2)
        points = (torch.rand(1024, 1, 3) - 0.75 + along[:, None] * directions).flatten(0, 1)
        table, at, grad = (
            torch.randn(grid.count, 12, requires_grad=True),
            grid.corners(points),
            torch.randn(51_200, 12),
        )

        def scatter(table=table, at=at, grad=grad) -> torch.Tensor:
            spread = (grad[:, None, :] * at.weights[:, :, None]).flatten(0, 1)
            return torch.zeros_like(table).index_add_(0, at.rows.flatten().long(), spread)

        found = lookup(table, at, sparse=True)
        sums = median_ms(partial(torch.autograd.grad, found, table, grad, retain_graph=True))
        print(f"gradient of 51,200 lookups in {side}^3 x 12: {sums:.1f} ms, by torch alone {median_ms(scatter):.1f} ms")
        compare("their corners", partial(grid.corners, points), by_torch_alone(grid.corners, points))
        found.backward(grad)
        optimizer = GridAdam([table])
        compare("Adam of the rows they touch", optimizer.step, by_torch(table, optimizer))

    space = Box(torch.tensor([[-1.0] * 3, [1.0] * 3]), 1.0, 5.0, 5.0)
    color = ViewMLP(features=12, channels=3, width=128, depth=3, frequencies=4)
    field = VoxelField(space, (64, 64, 64), 12, color, alpha_thre=1e-4, step=0.5, shift=-4.6)
    field.occupancy[:] = field.grid.vertices().norm(dim=1) < 0.6
    origins = 3 * F.normalize(torch.randn(1024, 3), dim=1)
    rays = Rays(origins, F.normalize(torch.rand(1024, 3) - 0.5 - origins, dim=1))
    compare(
        "samples outside free space of 1024 rays",
        lambda: field.samples(rays, 0.5),
        by_torch_alone(field.samples, rays, 0.5),
    )
    _, ray, points = field.samples(rays, 0.5)
    at, grad = field.grid.corners(points), torch.randn(len(ray), 1)
    found = lookup(field.density, at)
    compare(
        f"lookups of one channel at {len(ray):,} samples of rays",
        lambda: lookup(field.density, at),
        lambda: F.embedding_bag(at.rows, field.density, per_sample_weights=at.weights, mode="sum"),
    )
    compare(
        "their gradient",
        partial(torch.autograd.grad, found, field.density, grad, retain_graph=True),
        lambda: scattered.reference(*at, grad, field.density.shape, False),
    )
    depth = (3 * torch.rand(len(ray)) ** 6).requires_grad_()
    compare(
        f"weights of {len(ray):,} samples, forward and backward",
        lambda: volume_weights(depth, ray, 1024)[0].sum().backward(),
        lambda: volume_weights.reference(depth, ray, 1024)[0].sum().backward(),
    )

    mlp = ViewMLP(features=12, channels=3, width=128, depth=3, frequencies=4)
    directions = torch.randn(1024, 3)
    embedded, sizes = embed(directions, mlp.frequencies), iter(range(36_000, 38_000))

    def step(bf16: bool, whole: bool) -> None:
        samples = next(sizes)  # never the same number, as in training
        features, ray = torch.randn(samples, 12, requires_grad=True), torch.arange(samples) * 1024 // samples
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            latent = mlp.whole(features, embedded, ray) if whole else mlp(features, directions, ray)
        latent.sum().backward()

    with fast_products(torch.device("cpu")):
        for bf16 in (False, True):
            own, whole = (median_ms(partial(step, bf16, whole)) for whole in (False, True))
            kind = "bf16 products" if bf16 else "float32"
            print(f"MLP, 36,000 samples and a few, {kind}, in blocks: {own:.1f} ms, whole by torch {whole:.1f} ms")


if __name__ == "__main__":
    main()
