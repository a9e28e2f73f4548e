"""Size of the chunks of work on a GPU, by its memory."""

from __future__ import annotations

import torch

BASE_GIBIBYTES = 8
"""Memory in GiB of the GPU that chunks are sized for."""
MAX_SCALE = 16
"""Largest factor on a chunk; more rays at once are hardly faster."""


def times_a_chunk(device: torch.device) -> int:
    """Number of chunks to take at once on a device, one for each 8 GiB: few large launches are faster."""
    if device.type != "cuda":
        return 1
    return min(max(torch.cuda.get_device_properties(device).total_memory // (BASE_GIBIBYTES << 30), 1), MAX_SCALE)
