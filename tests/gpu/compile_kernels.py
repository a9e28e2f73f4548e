"""Compile every kernel for a GPU that is not there, as its trial would launch it: ``python compile_kernels.py``.

For compute capability 9.0, down to machine code. Prints a line a kernel: its name, and bytes of machine code.
"""

from __future__ import annotations

import inspect
from typing import Any

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from ctm_plugin import door
from ctm_plugin.gpu import adam, hash_grid, lookup, samples, splats, weights
from ctm_plugin.gpu.trial import TRIALS, _results

TARGET = GPUTarget("cuda", 90, 32)
NAMES = {torch.float32: "*fp32", torch.int32: "*i32", torch.int64: "*i64", torch.bool: "*i1"}


def type_of(value: Any) -> str:
    """An argument's type in Triton's words."""
    if isinstance(value, torch.Tensor):
        return NAMES[value.dtype]
    return "fp32" if isinstance(value, float) else "i32"


def compile_only(kernel: Any, programs: tuple[int, ...], *arguments: Any, **options: Any) -> None:
    """Stand in for ``launch``: tensors stay as they were made."""
    names = list(inspect.signature(kernel.fn).parameters)
    constants = {name: value for name, value in options.items() if name in names}
    signature = {name: type_of(value) for name, value in zip(names, arguments, strict=False)}
    assert [*signature, *constants] == names, f"{kernel.fn.__name__}: {[*signature, *constants]} for {names}"
    source = ASTSource(kernel, signature | dict.fromkeys(constants, "constexpr"), constants)
    rest = {"enable_fp_fusion": False} | {name: value for name, value in options.items() if name not in names}
    made = triton.compile(source, target=TARGET, options=rest)
    print(kernel.fn.__name__, len(made.asm["cubin"]), flush=True)


torch.Tensor.new_empty = torch.Tensor.new_ones  # no kernel fills them
for module in (adam, hash_grid, lookup, samples, splats, weights):
    module.launch = compile_only
for name, arguments in TRIALS.items():
    _results(door.named("gpu", name), arguments(torch.device("cpu")))
