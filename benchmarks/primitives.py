"""Choices in the step, each against its alternative: ``OMP_NUM_THREADS=1 python benchmarks/primitives.py``."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import torch
import torch.nn.functional as F

from ctm_plugin.allocator import keep_memory
from ctm_plugin.backbones.voxels import ViewMLP
from ctm_plugin.color.ctm import CTMConfig, SinusoidalMLP
from ctm_plugin.products import fast_products
from ctm_plugin.rays.encoding import embed
from ctm_plugin.rays.grid import Lattice, lookup


def median_ms(run: Callable[[], object], repeats: int = 9) -> float:
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return statistics.median(times) * 1e3


def products(rows: int) -> Callable[[], object]:
    """Those of one of CTM's networks, forward and backward, and nothing else."""
    table, hidden, out = (torch.rand(rows, columns) for columns in (27, 64, 3))
    first, last = torch.rand(64, 27), torch.rand(3, 64)
    return lambda: (
        table @ first.T, hidden @ last.T, out.T @ hidden, out @ last, hidden.T @ table, hidden @ first
    )  # fmt: skip


def main() -> None:
    keep_memory()
    torch.manual_seed(0)
    lattice = Lattice(torch.tensor([[-1.0] * 3, [1.0] * 3]), (64, 64, 64))
    rows = lattice.corners(torch.rand(150_000, 3) * 2 - 1).rows.flatten()
    values = torch.randn(len(rows), 3)
    for index in (rows, rows.long()):
        spent = median_ms(lambda index=index: torch.zeros(lattice.count, 3).index_add_(0, index, values))
        print(f"scatter of {len(rows):,} x 3 into 64^3, {index.dtype}: {spent:.1f} ms")

    for side in (64, 160):
        lattice = Lattice(torch.tensor([[-1.0] * 3, [1.0] * 3]), (side,) * 3)
        along = torch.arange(50) / side  # 50 samples on each of 1024 rays, two a voxel
        directions = F.normalize(torch.randn(1024, 1, 3), dim=2)
        points = (torch.rand(1024, 1, 3) - 0.75 + along[:, None] * directions).flatten(0, 1)
        table, at, grad = (
            torch.randn(lattice.count, 12, requires_grad=True),
            lattice.corners(points),
            torch.randn(51_200, 12),
        )

        def scatter(table=table, at=at, grad=grad) -> torch.Tensor:
            spread = (grad[:, None, :] * at.weights[:, :, None]).flatten(0, 1)
            return torch.zeros_like(table).index_add_(0, at.rows.flatten().long(), spread)

        found = lookup(table, at, sparse=True)
        sums = median_ms(lambda found=found, grad=grad: found.backward(grad, retain_graph=True))
        print(f"gradient of 51,200 lookups in {side}^3 x 12: sorted {sums:.1f} ms, ", end="")
        print(f"scattered {median_ms(scatter):.1f} ms")

    mlp = ViewMLP(features=12, channels=3, width=128, depth=3, frequencies=4)
    directions = torch.randn(1024, 3)
    embedded, sizes = embed(directions, mlp.frequencies), iter(range(36_000, 38_000))

    def step(bf16: bool, blocks: bool) -> None:
        samples = next(sizes)  # never the same number, as in training
        features, ray = torch.randn(samples, 12, requires_grad=True), torch.arange(samples) * 1024 // samples
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            latent = mlp(features, directions, ray) if blocks else mlp.whole(features, embedded, ray)
        latent.sum().backward()

    for bf16, blocks in ((False, False), (True, False), (True, True)):
        spent = median_ms(lambda bf16=bf16, blocks=blocks: step(bf16, blocks))
        kind = f"{'bf16' if bf16 else 'float32'}, {'in blocks' if blocks else 'whole'}"
        print(f"MLP, 36,000 samples and a few, {kind}: {spent:.1f} ms")

    layers = SinusoidalMLP(3, 3, CTMConfig())
    with fast_products(torch.device("cpu")):
        for rows in (1000, 8100, 162_000):
            color = torch.rand(rows, 3, requires_grad=True)
            for name, forward in (("as built", layers), ("operator by operator", layers.plain)):
                spent = median_ms(lambda forward=forward, color=color: forward(color).sum().backward())
                print(f"CTM's layers, {rows:,} colours, {name}: {spent:.2f} ms")
            print(f"CTM's layers, {rows:,} colours, their products alone: {median_ms(products(rows)):.2f} ms")


if __name__ == "__main__":
    main()
