"""Make the C allocator keep the memory of a training step for the next one, and give it back after a run."""

from __future__ import annotations

import ctypes
import gc

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD = -1, -2, -3  # glibc, malloc.h
_HALF_GIB = 1 << 29
"""Bytes in half a GiB."""


def keep_memory() -> bool:
    """Let glibc serve large blocks from its heap and not give them back to the kernel.

    By default each large tensor is a fresh mapping, whose page faults cost up to half of a step on the CPU.
    Elsewhere than on glibc this does nothing.

    Returns:
        Whether the settings were taken.
    """
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return False
    settings = {_M_MMAP_THRESHOLD: _HALF_GIB, _M_TRIM_THRESHOLD: 2**31 - 1, _M_TOP_PAD: 1 << 26}
    return sum(mallopt(name, value) for name, value in settings.items()) == len(settings)


def give_back() -> None:
    """Free what a run has left: a trainer and its module hold each other, and tensors never start a collection.

    Without it the runs of a sweep in one process would add up.
    """
    gc.collect()
    try:
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    except (OSError, AttributeError):  # elsewhere than on glibc
        return
