"""Training steps of which only the random numbers differ, as one launch on a GPU: a CUDA graph, recorded once."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable
from contextlib import AbstractContextManager
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from ctm_plugin import door
from ctm_plugin.draws import Draws, KnownDraws, NotedDraws

MAX_RECORDINGS = 100
"""Most recordings in a training: steps that keep changing are not worth it."""
TOLERANCE = 1e-3
"""Largest difference of a recorded gradient from the operators' own, relative to its norm."""


class Step(NamedTuple):
    """What a training step computes."""

    loss: Tensor
    """``[]``, the sum of the terms."""
    terms: dict[str, Tensor]
    """Weighted loss terms by name, ``[]``, without gradient."""
    shown: dict[str, Tensor]
    """To display, without gradient: ``latent`` as rendered and ``target``, ``[R, k]``, and ``rgb``, ``[R, 3]``."""


class Repeating(Protocol):
    """A module whose steps may be recorded."""

    def step_of(self, draws: Draws) -> Step:
        """A step out of its random numbers and the module's tensors."""

    def repeats(self) -> Hashable | None:
        """What else the next step depends on, asked once a step; ``None``: it may not be recorded now."""

    def fixed_sizes(self) -> AbstractContextManager[None]:
        """Within it a step waits for nothing, and the sizes of its tensors stay."""


class Replay:
    """Makes a module's steps; on a GPU, replays them, where :meth:`Repeating.repeats` says that they are the same.

    Most operators of a step are small: they cost their launches, not their arithmetic. What is recorded is compared
    with the operators one at a time; where it differs or cannot be recorded, those run.
    """

    def __init__(self) -> None:
        self.recorded: Recorded | None = None
        self.key: Hashable = None
        self.left = MAX_RECORDINGS

    def __reduce__(self) -> tuple[type[Replay], tuple[()]]:
        return Replay, ()  # a copy's tensors are elsewhere

    def __call__(self, module: Any, draws: Draws) -> Step:
        """Make a step of a :class:`Repeating` module out of these numbers."""
        key = self._key(module) if self.left and draws.world == 1 and may_record(module) else None
        if key is None:
            return module.step_of(draws)
        if key == self.key:
            return self.recorded.step(draws)
        noted = NotedDraws(draws)
        step = module.step_of(noted)
        self._record(key, module, noted, step)
        return step

    @staticmethod
    def _key(module: Any) -> Hashable | None:
        if (repeats := module.repeats()) is None:
            return None
        kind = module.device.type
        cast = torch.is_autocast_enabled(kind), torch.get_autocast_dtype(kind)
        return repeats, cast, tuple((each.data_ptr(), each.shape) for each in tensors_of(module))

    def _record(self, key: Hashable, module: Any, noted: NotedDraws, step: Step) -> None:
        self.left -= 1
        self.recorded = self.key = None  # its memory goes first
        try:
            self.recorded, self.key = Recorded(module, noted, step), key
        except Exception as error:  # whatever a driver may say
            self.left = 0
            warnings.warn(f"Steps are not replayed, which is slower: {error}", stacklevel=4)


def may_record(module: Any) -> bool:
    """Whether gradients are wanted, and kernels are for the module's parameters."""
    return torch.is_grad_enabled() and door.may_launch([*module.parameters()][:1])


def tensors_of(module: nn.Module) -> list[Tensor]:
    """Parameters and buffers ``[...]``."""
    return [*module.parameters(), *module.buffers()]


class Recorded:
    """A step, and the gradients of its loss.

    Args:
        module: :class:`Repeating`.
        noted: the numbers of the step, which are there.
        step: what was computed of them one operator at a time.

    Raises:
        RuntimeError: it cannot be recorded, or what was recorded gives something else.
    """

    def __init__(self, module: Any, noted: NotedDraws, step: Step):
        self.module, self.asked = module, noted.asked
        self.inputs = [each.clone() for each in noted.given]
        self.parameters = [each for each in module.parameters() if each.requires_grad]
        plain = torch.autograd.grad(step.loss, self.parameters, retain_graph=True, allow_unused=True)
        self.wanted = [each for each, grad in zip(self.parameters, plain, strict=True) if grad is not None]
        self.again, (self.found, self.grads) = record(lambda: self.compute(noted))
        self.again()
        known = [step.loss, *(grad for grad in plain if grad is not None)]
        for one, other in zip(known, [self.found.loss, *self.grads], strict=True):
            if not (other - one).norm() <= TOLERANCE * one.norm():
                raise RuntimeError("what was recorded gives something else")

    @torch.enable_grad()
    def compute(self, draws: Draws) -> tuple[Step, tuple[Tensor, ...]]:
        kind = self.module.device.type
        # What is cast once for a whole step would not be cast again when the step is replayed.
        cast = torch.autocast(
            kind, torch.get_autocast_dtype(kind), enabled=torch.is_autocast_enabled(kind), cache_enabled=False
        )
        with self.module.fixed_sizes(), cast:
            step = self.module.step_of(KnownDraws(draws, self.inputs))
            grads = torch.autograd.grad(step.loss, self.wanted)
        return step._replace(loss=step.loss.detach()), grads

    def step(self, draws: Draws) -> Step:
        """Replay it with other numbers; what it gives is written over by the next."""
        given = [getattr(draws, kind)(*sizes) for kind, sizes in self.asked]
        torch._foreach_copy_(self.inputs, given)
        self.again()
        return self.found._replace(loss=Replayed.apply(self, *self.wanted))


class Replayed(torch.autograd.Function):
    """The loss ``[]`` that :class:`Recorded` has found, of the parameters ``[...]``, whose gradients it has too."""

    @staticmethod
    def forward(ctx: Any, recorded: Recorded, *parameters: Tensor) -> Tensor:
        ctx.grads = recorded.grads
        return recorded.found.loss.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        return None, *torch._foreach_mul(ctx.grads, grad)


def record(compute: Callable[[], Any]) -> tuple[Callable[[], None], Any]:
    """Give what computes again, and what was computed, which is then written over.

    Source: *CUDA graphs*, PyTorch's notes on CUDA semantics.
    """
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):  # libraries take their memory at the first
            compute()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        results = compute()
    return graph.replay, results
