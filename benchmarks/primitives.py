"""Choices in the step, each against its alternative: ``OMP_NUM_THREADS=1 python benchmarks/primitives.py``."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import torch

from ctm_plugin.allocator import keep_memory
from ctm_plugin.backbones.voxels import ViewMLP
from ctm_plugin.color.ctm import CTMConfig, SinusoidalMLP
from ctm_plugin.products import fast_products
from ctm_plugin.rays.grid import Lattice


def median_ms(run: Callable[[], object], repeats: int = 9) -> float:
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return statistics.median(times) * 1e3


def main() -> None:
    keep_memory()
    torch.manual_seed(0)
    lattice = Lattice(torch.tensor([[-1.0] * 3, [1.0] * 3]), (64, 64, 64))
    rows = lattice.corners(torch.rand(150_000, 3) * 2 - 1).rows.flatten()
    values = torch.randn(len(rows), 3)
    for index in (rows, rows.long()):
        spent = median_ms(lambda index=index: torch.zeros(lattice.count, 3).index_add_(0, index, values))
        print(f"scatter of {len(rows):,} x 3 into 64^3, {index.dtype}: {spent:.1f} ms")

    mlp = ViewMLP(features=12, channels=3, width=128, depth=3, frequencies=4)
    features = torch.randn(36_000, 12, requires_grad=True)
    directions, ray = torch.randn(1024, 3), torch.randint(1024, (36_000,)).sort()[0]

    def step(bf16: bool) -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            latent = mlp(features, directions, ray)
        latent.sum().backward()

    for bf16 in (False, True):
        print(f"MLP, 36,000 samples, {'bf16' if bf16 else 'float32'}: {median_ms(lambda bf16=bf16: step(bf16)):.1f} ms")

    layers = SinusoidalMLP(3, 3, CTMConfig())
    with fast_products(torch.device("cpu")):
        for rows in (1000, 8100, 162_000):
            color = torch.rand(rows, 3, requires_grad=True)
            for name, forward in (("as built", layers), ("operator by operator", layers.plain)):
                spent = median_ms(lambda forward=forward, color=color: forward(color).sum().backward())
                print(f"CTM's layers, {rows:,} colours, {name}: {spent:.2f} ms")


if __name__ == "__main__":
    main()
