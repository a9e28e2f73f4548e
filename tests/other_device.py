"""A device that is not the CPU, where there is none: tensors on the CPU that say they are elsewhere.

They are torch's *meta* device by name, compute on the CPU, and are refused beside tensors that are not on it, as a GPU
would refuse them. What makes a GPU and its host wait for one another is written down.
"""

from __future__ import annotations

import traceback
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from lightning.fabric.utilities.device_dtype_mixin import _DeviceDtypeModuleMixin
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.strategies import SingleDeviceStrategy
from torch import Tensor, nn
from torch.optim import adam, optimizer
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

import ctm_plugin

DEVICE = torch.device("meta")
MIXES = {"copy_", "_to_copy", "index", "index_put_", "_index_put_impl_"}
"""Operators that take tensors of both devices; of others a single number of the CPU's is let in."""
WAITS = {"_local_scalar_dense", "nonzero", "masked_select", "equal", "repeat_interleave", "_unique2", "unique_dim"}
"""Operators whose result's shape, or the result, the host has to know."""
PACKAGE = str(Path(ctm_plugin.__file__).parent)

# What devices are tested with, and what the host waits for in a step of it.

STAGES = ("coarse=true", "coarse_steps=8", "steps=12", "grow=[4]", "occupancy_first=2")
PLANAR = ("backbone=barf2d", "dataset=planar", "dataset.height=48", "dataset.width=64", "dataset.patch=24")
SETTINGS = {
    "dvgo": ("backbone=dvgo", *(f"backbone.{each}" for each in STAGES)),
    "dvgo, forward": (
        "backbone=dvgo",
        "dataset=llff",
        "dataset.root=HALL",
        "backbone.planes=8",
        "loss=l1",
        "color_space=log",
    ),
    "nerf": ("backbone=nerf", "color_space=log"),
    "ngp": ("backbone=ngp", "color_space=log"),
    "splat": ("backbone=splat", "color_space=gain", "backbone.threshold=1e-6", "backbone.per_pixel=0.075"),
    "barf2d": PLANAR,
    "barf2d, all pixels": (*PLANAR, "backbone.pixels=null", "color_space=lab"),
}
BRIEF = ("ctm=quick", "ctm.pretrain_steps=3", "trainer.log_every=5", "trainer.image_every=10")
# Samples of each ray, those outside free space, those with alpha, those with weight.
PACKED = ["_local_scalar_dense in pack_samples", "nonzero in occupied_samples", *["nonzero in forward"] * 2]
STEP_WAITS = {
    "dvgo": PACKED,
    "dvgo, forward": PACKED,
    "nerf": [],
    # Samples of each ray, those outside free space, those that light reaches, those with alpha, those with weight.
    "ngp": [*PACKED[:2], "nonzero in visible_samples", *PACKED[2:]],
    "splat": ["nonzero in rasterize"],  # in plain torch: which Gaussians meet a tile, of which there is one
    "barf2d": [],
    "barf2d, all pixels": [],
}

waits: list[str] = []
"""Since the device was switched on: the operator, and the innermost function of the package that it was called in."""


class Elsewhere(torch.Tensor):
    """A tensor of the device; ``inner`` is where its numbers are."""

    inner: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, inner: Tensor) -> Elsewhere:
        layout = {"strides": inner.stride(), "storage_offset": inner.storage_offset(), "dtype": inner.dtype}
        made = torch.Tensor._make_wrapper_subclass(cls, inner.size(), device=DEVICE, **layout)
        made.inner = inner
        return made

    @property
    def data(self) -> Tensor:
        return self.detach()

    @data.setter
    def data(self, value: Elsewhere) -> None:
        torch._C.TensorBase.data.__set__(self, value)
        self.inner = value.inner

    def tolist(self) -> list:
        note("tolist")
        return self.inner.tolist()

    def new_tensor(self, *args: Any, **options: Any) -> Elsewhere:
        return Elsewhere(torch.tensor(*args, **{"dtype": self.dtype} | options))

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        return run(func, args, kwargs or {})


def note(name: str) -> None:
    frames = [frame for frame in traceback.extract_stack() if frame.filename.startswith(PACKAGE)]
    waits.append(f"{name} in {frames[-1].name if frames else 'no function of the package'}")


def run(func: Any, args: tuple, kwargs: dict) -> Any:
    """An operator, on the CPU.

    Raises:
        RuntimeError: it was given tensors of both devices.
    """
    name = func.overloadpacket.__name__
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    ours = [tensor for tensor in tensors if isinstance(tensor, Elsewhere)]
    others = [tensor for tensor in tensors if not isinstance(tensor, Elsewhere)]
    assert all(other.device != DEVICE for other in others), f"{func} made what has no numbers"
    if ours and name not in MIXES and any(other.dim() for other in others):
        raise RuntimeError(f"{func}: found tensors of both devices, expected those of one")
    target = kwargs.get("device")
    target = (DEVICE if ours else torch.device("cpu")) if target is None else torch.device(target)
    if name == "copy_":
        target = args[0].device
    masked = name.startswith(("index", "_index_put")) and any(t.dtype in (torch.bool, torch.uint8) for t in ours[1:])
    counted = name == "repeat_interleave" and kwargs.get("output_size") is not None  # its length is known
    if ours and not counted and (name in WAITS or masked or target != DEVICE):
        note(name)

    def inner(leaf: Any) -> Any:
        if isinstance(leaf, torch.device):
            return torch.device("cpu")
        return leaf.inner if isinstance(leaf, Elsewhere) else leaf

    found = func(*tree_map(inner, args), **tree_map(inner, kwargs))
    if target != DEVICE:
        return found
    given = {id(tensor.inner): tensor for tensor in ours}  # operators in place give back what they were given

    def outer(leaf: Any) -> Any:
        if not isinstance(leaf, Tensor):
            return leaf
        return given[id(leaf)] if id(leaf) in given else Elsewhere(leaf)

    return tree_map(outer, found)


class Everywhere(TorchDispatchMode):
    """For operators without a tensor of the device that are told to make one."""

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        return run(func, args, kwargs or {})


def move(module: nn.Module, there: bool) -> nn.Module:
    """Parameters and buffers of a module to the device, or back; one that several parts share stays one."""
    moved: dict[int, Tensor] = {}
    for part in module.modules():
        for store in (part._parameters, part._buffers):
            for name, tensor in store.items():
                if tensor is None or isinstance(tensor, Elsewhere) == there:
                    continue
                if id(tensor) not in moved:
                    other = Elsewhere(tensor.detach()) if there else tensor.inner
                    parameter = store is part._parameters
                    moved[id(tensor)] = nn.Parameter(other, tensor.requires_grad) if parameter else other
                store[name] = moved[id(tensor)]
        if hasattr(part, "_device"):
            part._device = DEVICE if there else torch.device("cpu")
    return module


class Accelerator(CPUAccelerator):
    def setup_device(self, device: torch.device) -> None:
        pass


def strategy(*_: Any) -> SingleDeviceStrategy:
    return SingleDeviceStrategy(device=DEVICE, accelerator=Accelerator())


@contextmanager
def switched_on():
    """What torch and Lightning decide by a device's name, they decide as for one that they know."""
    make, wrap, generator, autocast, save = torch.tensor, torch.as_tensor, torch.Generator, torch.autocast, torch.save
    moves = {kind: kind.to for kind in (nn.Module, _DeviceDtypeModuleMixin)}

    def placed(function: Any) -> Any:
        def made(data: Any, *args: Any, device: Any = None, **options: Any) -> Tensor:
            found = function(data, *args, **options)
            there = device is not None and torch.device(device) == DEVICE and not isinstance(found, Elsewhere)
            return Elsewhere(found) if there else found

        return made

    def to(kind: type) -> Any:
        def moved(module: nn.Module, *args: Any, **options: Any) -> nn.Module:
            target = args[0] if args else options.get("device")
            if isinstance(target, str | torch.device):
                return move(module, torch.device(target) == DEVICE)
            return moves[kind](module, *args, **options)

        return moved

    class Autocast(autocast):
        def __init__(self, device_type: str, *args: Any, **options: Any):
            super().__init__("cpu" if device_type == DEVICE.type else device_type, *args, **options)

    def saved(value: Any, *args: Any, **options: Any) -> None:
        save(tree_map(lambda leaf: leaf.inner if isinstance(leaf, Elsewhere) else leaf, value), *args, **options)

    class Generator(generator):
        def __new__(cls, *_: Any) -> Generator:
            return super().__new__(cls)

    with ExitStack() as stack:
        for owner, name, value in [
            (torch, "tensor", placed(make)), (torch, "as_tensor", placed(wrap)), (torch, "autocast", Autocast),
            (torch, "Generator", Generator), (torch, "save", saved),
            *((kind, "to", to(kind)) for kind in moves),
            *((kind, "cpu", lambda module: move(module, False)) for kind in moves),
            *((part, "_get_fused_kernels_supported_devices", lambda: [DEVICE.type]) for part in (adam, optimizer)),
        ]:  # fmt: skip
            stack.enter_context(patch.object(owner, name, value, create=True))
        stack.enter_context(Everywhere())
        waits.clear()
        yield
