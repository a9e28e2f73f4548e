"""What a step hands over to a GPU, how long the GPU works on it, and where the host waits, by torch's profiler."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch.autograd import DeviceType
from torch.autograd.profiler_util import FunctionEvent
from torch.profiler import profile, supported_activities

from ctm_plugin.callbacks.stopwatch import synchronise

LAUNCH = re.compile(r"cu(da)?(Launch|GraphLaunch|Memcpy|Memset)")
WAIT = re.compile(r"cu(da)?(Stream|Event)Synchronize")
ITEM = re.compile("aten::_local_scalar_dense")
PRODUCT = re.compile(r"aten::(mm|addmm|bmm|baddbmm)$")
LONGEST = 10
"""Kernels that are named."""


def profiled(step: Callable[[], object], device: torch.device, steps: int = 8) -> dict[str, Any]:
    """Make some steps under the profiler, see :func:`per_step`; it slows the host, in some versions afterwards too."""
    with profile(activities=supported_activities(), with_flops=True) as profiler:
        for _ in range(steps):
            step()
        synchronise(device)
    return per_step(profiler.events(), steps)


def per_step(events: Iterable[FunctionEvent], steps: int) -> dict[str, Any]:
    """Count launches and waits by their names, numbers that the host reads (those on the CPU make nobody wait), the
    GPU's milliseconds, those of the longest kernels by their names, and TFLOP of matrix products.

    The GPU's time is that of kernels and copies, each once. The profiler gives it to the operator that launched them
    too, and has ranges on the GPU, of ``record_function``, that span the gaps between kernels.
    """
    events = list(events)
    host = [event for event in events if event.device_type == DeviceType.CPU]
    kernels: Counter[str] = Counter()
    for event in events:
        if event.device_type != DeviceType.CPU and not event.is_user_annotation:
            kernels[event.name] += event.time_range.elapsed_us() / 1e3 / steps

    def count(names: re.Pattern[str]) -> dict[str, float]:
        found = Counter(event.name for event in host if names.match(event.name))
        return {name: number / steps for name, number in found.most_common()}

    return {
        "launches": count(LAUNCH),
        "waits": count(WAIT),
        "items": sum(count(ITEM).values()),
        "device_ms": sum(kernels.values()),
        "longest_ms": dict(kernels.most_common(LONGEST)),
        "product_tflop": sum(event.flops for event in host if PRODUCT.match(event.name)) / 1e12 / steps,
    }
