"""What the machine can do at most: products of matrices and copies."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

from ctm_plugin.callbacks.stopwatch import synchronise

REPEATS = 7
ENOUGH_S = 0.02
"""A product of this length is timed well enough."""


def best_seconds(work: Callable[[], object], device: torch.device, repeats: int = REPEATS) -> float:
    """Take the least time of several runs, after one that is not timed."""
    work()
    times = []
    for _ in range(repeats):
        synchronise(device)
        start = time.perf_counter()
        work()
        synchronise(device)
        times.append(time.perf_counter() - start)
    return min(times)


def matrix_peak(device: torch.device, dtype: torch.dtype) -> float:
    """Measure the FLOP/s of a square product, as torch is set now: the best ``2 n^3 / seconds`` of n doubled.

    Up to 2048 on a CPU and 8192 on a GPU, while a product takes less than ``ENOUGH_S``: a CPU without bfloat16 products
    is hundreds of times slower at them.
    """
    size, largest, best = 256, 8192 if device.type == "cuda" else 2048, 0.0
    while True:
        a, b = (torch.randn(size, size, device=device).to(dtype) for _ in range(2))
        seconds = best_seconds(lambda a=a, b=b: a @ b, device)
        best = max(best, 2 * size**3 / seconds)
        if size == largest or seconds > ENOUGH_S:
            return best
        size *= 2


def copy_rate(device: torch.device) -> float:
    """Measure the bytes/s read and written in a copy of 256 MiB."""
    source = torch.zeros(1 << 26, device=device)
    target = torch.zeros_like(source)  # its pages must be there
    return 2 * source.numel() * 4 / best_seconds(lambda: target.copy_(source), device)


def describe(device: torch.device) -> dict[str, object]:
    """Tell a device's name, threads, torch's version, and both limits: FLOP/s of products and bytes/s of copies."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else cpu_name()
    return {
        "device": name,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "float32_flops": matrix_peak(device, torch.float32),
        "bfloat16_flops": matrix_peak(device, torch.bfloat16),
        "copy_bytes_per_second": copy_rate(device),
    }


def cpu_name() -> str:
    """Tell the processor's name, where the system does."""
    try:
        with open("/proc/cpuinfo") as lines:
            return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return "CPU"
