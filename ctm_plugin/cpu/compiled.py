"""Compilation of functions of tensors by numba, with a cache, for this CPU."""

from __future__ import annotations

import functools
import inspect
import sys
import threading
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import torch
from filelock import FileLock
from numba.core import caching
from torch import Tensor

from ctm_plugin.cpu.threads import loop_threads

_LOCK = threading.Lock()
"""Lock of all loops where no OpenMP is found: numba's own threads end the process if two threads of Python call at
once."""

FUSED = {"contract", "reassoc", "nsz"}
"""LLVM's fast-math flags that ``fused`` allows."""

LOCK_S = 120.0
"""Seconds to wait for another process that compiles."""


def compiled(signature: str, fused: bool = False, parallel: bool = True) -> Callable[[Callable], Callable]:
    """Make a function's loops machine code, by numba, when it is first called.

    It is given tensors on the CPU, which it sees as arrays, and numbers. ``prange`` loops run on as many threads as
    torch has; a process that was forked after the first call cannot run them under OpenMP. Results do not depend on the
    number of threads unless the loops do: the machine code is the same. Another processor's may differ in the last bits
    where it is ``fused``. What was compiled is kept, for each kind of processor, next to the package or in the user's
    cache.

    Args:
        signature: types of the arguments, the only ones accepted, as a numba signature.
        fused: let sums be reordered, and products rounded together with them, as libraries of matrix products do.
        parallel: run ``prange`` loops on several threads.

    Raises:
        TypeError: when called with arguments of other types, or tensors that are not contiguous.
    """

    def decorate(function: Callable) -> Callable:
        raw = inspect.unwrap(function)  # type checkers of tests wrap functions
        kernel = None

        @functools.wraps(raw)
        def call(*arguments: Any) -> Any:
            nonlocal kernel
            arrays = [each.detach().numpy() if isinstance(each, Tensor) else each for each in arguments]
            with _LOCK:
                _start_threads()  # compiling what is parallel would, too
                kernel = kernel or _machine_code(raw, signature, fused, parallel)
                numba.set_num_threads(min(loop_threads(), numba.config.NUMBA_NUM_THREADS))
                return kernel(*arrays)

        return call

    return decorate


def inlined(function: Callable) -> Callable:
    """Decorate a function to be inlined into compiled functions."""
    return numba.njit(inline="always")(inspect.unwrap(function))


def fused_part(function: Callable) -> Callable:
    """Decorate a function to be called by compiled functions, compiled with them, with the math of ``fused``."""
    options = {"error_model": "numpy", "fastmath": FUSED, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return numba.njit(**options)(inspect.unwrap(function))


@functools.cache
def _announce() -> None:
    """Print once that the first step waits for compilation."""
    print("compiling loops for this processor, once; it takes half a minute", file=sys.stderr, flush=True)


@functools.cache
def _start_threads() -> None:
    """Start numba's threads; under OpenMP that changes torch's number of threads, which is restored."""
    threads = torch.get_num_threads()
    numba.get_num_threads()
    torch.set_num_threads(threads)


@functools.cache
def _not_kept(folder: Path, kind: type[Exception]) -> None:
    """Warn once that compiled code cannot be kept, so that every process compiles anew."""
    warnings.warn(f"compiled loops cannot be kept in {folder} ({kind.__name__}): each run compiles anew", stacklevel=3)


def _of_what_is_kept(error: Exception) -> bool:
    """Whether an error comes from the cache: a folder that is not writable or lockable, or a damaged file in it."""
    places = [frame.f_code.co_filename for frame, _ in traceback.walk_tb(error.__traceback__)]
    return isinstance(error, OSError | NotImplementedError) or caching.__file__ in places


def _machine_code(function: Callable, signature: str, fused: bool, parallel: bool) -> Callable:
    """Compile a function, or load its code from the cache; where it cannot be kept, compile anew, with a warning.

    One process at a time compiles a function: numba's files, written by several at once, may end with one signature's
    code under the key of another.
    """
    options = {"parallel": parallel, "nogil": True, "error_model": "numpy"}
    options |= {"fastmath": FUSED} if fused else {}
    name = f"{Path(inspect.getfile(function)).stem}.{function.__name__}"  # as numba calls its files
    folder = Path(__file__).parent
    try:
        kernel = numba.njit(cache=True, **options)(function)
        folder = Path(kernel.stats.cache_path)
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / f"{name}.lock", timeout=LOCK_S):
            kept = list(folder.glob(f"{name}-*.nbi"))
            newest = max(path.stat().st_mtime for path in Path(__file__).parent.glob("*.py"))
            for index in kept:  # numba only looks at the function's own file, not at those of its parts and options
                if index.stat().st_mtime < newest:
                    index.unlink()
            if not kept:
                _announce()
            kernel.compile(signature)
    except Exception as error:
        if not _of_what_is_kept(error):
            raise
        _not_kept(folder, type(error))
        kernel = numba.njit(**options)(function)
        kernel.compile(signature)
    kernel.disable_compile()
    return kernel
