"""Several processes for one run: starting them, and stopping them together."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ctm_plugin.errors import CTMError

GRACE_S = 10.0
"""Seconds that other processes may take to end after one has failed."""


@contextmanager
def processes(run: Path, count: int) -> Iterator[None]:
    """Start the other processes of a run on this machine, and end them with it.

    Each is ``python -m ctm_plugin resume=RUN``: it needs nothing of this process but the run directory, so that sweeps,
    launchers and calls from Python work like the command line. Where torchrun or the like started this process, the
    others are there already.

    Args:
        run: a run directory with its configuration.
        count: number of processes, this one included.

    Raises:
        CTMError: another process failed.
    """
    if count == 1 or "LOCAL_RANK" in os.environ:
        yield
        return
    import torch
    from lightning.fabric.plugins.environments.lightning import find_free_network_port

    shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(find_free_network_port()), "NODE_RANK": "0"}
    shared |= {"WORLD_SIZE": str(count), "LOCAL_RANK": "0"}
    before = {name: os.environ[name] for name in shared if name in os.environ}
    os.environ |= shared
    command = [sys.executable, "-m", "ctm_plugin", f"resume={run.resolve()}"]
    others = [subprocess.Popen(command, env=os.environ | {"LOCAL_RANK": str(rank)}) for rank in range(1, count)]
    done, patience = threading.Event(), 0.0
    threading.Thread(target=_watch, args=(others, done), daemon=True).start()
    try:
        yield
        patience = GRACE_S
    except Exception as error:
        # Where one process fails, the others see no more than a lost connection.
        if not isinstance(error, CTMError) and (failure := _failure(others, GRACE_S)):
            raise CTMError(failure) from error
        raise
    finally:
        done.set()
        _end(others, patience)
        if torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()
        for name in shared:
            os.environ.pop(name, None)
        os.environ |= before


def _failure(others: list[subprocess.Popen], seconds: float) -> str | None:
    """Description of the first process that fails within ``seconds``; ``None``: none does."""
    until = time.monotonic() + seconds
    while True:
        for rank, process in enumerate(others, start=1):
            if process.poll():
                return f"process {rank} of the run ended with exit code {process.returncode}; its message is above"
        if time.monotonic() > until:
            return None
        time.sleep(0.05)


def _watch(others: list[subprocess.Popen], done: threading.Event) -> None:
    """End this process when another one failed and left it waiting for ever."""
    while not done.wait(1.0):
        if (failure := _failure(others, 0.0)) and not done.wait(GRACE_S):
            print(f"error: {failure}", file=sys.stderr, flush=True)
            _end(others, 0.0)
            os._exit(1)


def _end(others: list[subprocess.Popen], patience: float) -> None:
    """Let the processes end by themselves for ``patience`` seconds, then end them."""
    for process in others:
        with suppress(subprocess.TimeoutExpired):
            process.wait(patience)
        process.kill()
        process.wait()
