"""Number of threads in a training step, and how OpenMP's threads wait, which can be set without importing torch."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

WAIT_VARIABLES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
"""Environment variables that set how OpenMP's threads wait."""
MAX_SPINS = 1000
"""Turns of the loop in which a thread waits awake, 20 to 50 us: as long as it takes to wake one."""

_loops: list[int] = []


def let_waiting_threads_sleep() -> None:
    """Have OpenMP, once it is loaded, put threads to sleep that wait, unless the environment says how they wait.

    By default threads spin for milliseconds. Where another program shares the cores, spinning threads take the time of
    the thread they wait for: a step then takes ten times as long.
    """
    if not any(name in os.environ for name in WAIT_VARIABLES):
        os.environ["GOMP_SPINCOUNT"] = str(MAX_SPINS)


def warn_of_neighbours() -> None:
    """Warn where threads spin while programs keep all cores busy, as when torch was imported before this package."""
    import torch

    text = any(name in os.environ for name in WAIT_VARIABLES)
    if not text and torch.get_num_threads() > 1 and os.getloadavg()[0] >= (os.cpu_count() or 1):
        way_out = "start Python with OMP_WAIT_POLICY=passive, as ctm does"
        warnings.warn(
            f"other programs keep all cores busy, and threads that wait slow each other: {way_out}", stacklevel=3
        )


@contextmanager
def operators_on_one_thread(wanted: bool = True) -> Iterator[None]:
    """Context in which torch's operators run on one thread, and loops on as many as torch had.

    Where loops do the work, operators between them are small: threads wait longer for each other than they compute.
    """
    import torch

    threads = torch.get_num_threads()
    if not wanted or threads == 1:
        yield
        return
    _loops.append(threads)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        _loops.pop()


def loop_threads() -> int:
    """Number of threads on which compiled loops run."""
    import torch

    return _loops[-1] if _loops else torch.get_num_threads()
