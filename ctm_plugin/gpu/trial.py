"""Trial of every kernel before its first use: on a small input, against the plain torch function it stands for."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

TOLERANCE = 2e-5
"""Largest accepted difference of results, as a share of the largest number: float32 sums of some hundred numbers."""


def tried(kernel: str, find: Callable[[], Callable], reference: Callable, device: torch.device) -> Callable:
    """Give the kernel that ``find`` imports if it agrees with ``reference`` on a device, else that, with a warning."""
    try:
        run = find()
        with torch.autocast(device.type, enabled=False), torch.enable_grad():
            results, expected = (_results(each, TRIALS[kernel](device)) for each in (run, reference))
        wrong = [_apart(*pair) for pair in zip(results, expected, strict=True)]
        if max(wrong) <= TOLERANCE:
            return run
        why = f"its results are off by {max(wrong):.1g} of the largest"
    except Exception as error:  # whatever a compiler or a driver may say
        warning = str(error).strip().splitlines() or ["nothing more is known"]
        why = f"it does not run ({type(error).__name__}: {warning[-1]})"
    warnings.warn(f"the kernel {kernel} is not used on {device}: {why}; plain torch runs, slower", stacklevel=3)
    return reference


def _apart(one: Tensor, other: Tensor) -> float:
    """Largest difference of two tensors as a share of the largest number; infinite if shapes, types or NaN differ."""
    if (one.shape, one.dtype) != (other.shape, other.dtype):
        return torch.inf
    one, other = one.detach().double(), other.detach().double()
    apart = ((one - other).abs().max() / other.abs().max().clamp_min(1e-30)).item()
    return apart if apart == apart else torch.inf


def _results(run: Callable, arguments: tuple) -> list[Tensor]:
    """Run a function; give its results, its arguments afterwards, and the arguments' gradients."""
    results, given = list(_leaves([run(*arguments)])), list(_leaves(arguments))
    wanted = [each for each in given if each.requires_grad]
    if wanted:
        loss = sum((each * torch.arange(each.numel(), device=each.device).view_as(each)).sum() for each in results)
        results += torch.autograd.grad(loss, wanted)
    return [*results, *given]


def _leaves(of: Any) -> Iterator[Tensor]:
    for each in of:
        if isinstance(each, Tensor):
            yield each
        elif isinstance(each, tuple):
            yield from _leaves(each)


# A grid of halves and rays along its axes: no rounding puts a sample to another vertex.
def _grid(device: torch.device) -> tuple[Tensor, ...]:
    last = torch.tensor([4.0, 5.0, 6.0], device=device)
    offsets = torch.tensor([0, 1, 7, 8, 42, 43, 49, 50], dtype=torch.int32, device=device)
    return -torch.ones(3, device=device), torch.full((3,), 2.0, device=device), last, offsets


def _rand(device: torch.device, *shape: int) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(len(shape))).to(device)


def _of_rows(device: torch.device) -> tuple[Tensor, Tensor]:
    return (210 * _rand(device, 1200)).int().view(150, 8), _rand(device, 150, 8)


def _of_samples(device: torch.device) -> tuple[Any, ...]:
    axes = torch.eye(3).repeat(3, 1).to(device)
    origins = torch.tensor([-0.875, -0.625, -0.375]).repeat_interleave(3)[:, None].expand(9, 3).to(device)
    occupied = (torch.arange(210) % 3 > 0).to(device)
    counts = torch.arange(9, device=device) * 9
    return origins, axes, torch.zeros(9, device=device), counts, 0.03125, occupied, *_grid(device)


def _of_hashes(device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    return _rand(device, 150, 3), torch.tensor([4, 13], device=device), torch.tensor([0, 125, 381], device=device)


def _of_splats(device: torch.device) -> tuple[Any, ...]:
    """Arguments for a trial: faint Gaussians all over a picture, so that no alpha meets a bound or ends a tile."""
    conics = torch.tensor([[0.001, 0.0002, 0.002]], device=device).repeat(9, 1)
    learned = 40 * _rand(device, 9, 2), conics, 0.1 + 0.1 * _rand(device, 9)
    extents, colors = torch.full((9, 2), 99.0, device=device), _rand(device, 9, 3).requires_grad_()
    return *(each.requires_grad_() for each in learned), extents, _rand(device, 9), colors, 37, 21


TRIALS: dict[str, Callable[[torch.device], tuple]] = {
    "adam:step_table": lambda device: (
        _rand(device, 150, 12), (_rand(device, 150, 12) - 0.5) * (torch.arange(150, device=device)[:, None] % 3 > 0),
        *(_rand(device, 150, 12) for _ in range(2)), None, 3, 0.1, (0.9, 0.99), 1e-8,
    ),
    "lookup:corners": lambda device: (2.5 * _rand(device, 3, 150).T - 1.1, *_grid(device)),
    "lookup:weighted": lambda device: (_rand(device, 210, 12), *_of_rows(device)),
    "lookup:scattered": lambda device: (*_of_rows(device), _rand(device, 150, 12), torch.Size([210, 12]), False),
    "samples:occupied_samples": _of_samples,
    "weights:VolumeWeights.apply": lambda device: (
        (3 * _rand(device, 400) ** 4).requires_grad_(), (torch.arange(400, device=device) / 20).sqrt().long(), 5,
    ),
    "hash_grid:encoded": lambda device: (_rand(device, 381, 2), *_of_hashes(device)),
    "splats:rasterize": _of_splats,
    "hash_grid:spread": lambda device: (_rand(device, 150, 4), *_of_hashes(device), torch.Size([381, 2])),
}  # fmt: skip
"""Functions that make each kernel's arguments for its trial, the same each time; their last blocks are not full."""
