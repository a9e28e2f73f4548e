"""Loss terms of tensors whose shapes stay, and their gradients, as one launch on a GPU: a CUDA graph, recorded once."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import torch
from torch import Tensor

Terms = Callable[..., tuple[dict[str, Tensor], Tensor]]
"""Of tensors: weighted loss terms ``[]`` by name, which are to be summed, and what else was found, without gradient."""

RECORDINGS = 8
"""So many shapes are recorded; a function whose shapes never stay is not worth it."""
APART = 1e-3
"""Of the norm of what was computed one operator at a time, what was recorded may differ by this."""


class Replay:
    """Run :data:`Terms` as they are; on a GPU, while gradients are wanted, replay them.

    A step's small operators cost their launches, not their arithmetic. The recording is of the sum's gradients, so
    that all terms have to weigh the same in what is differentiated. What is recorded is compared with the operators
    one at a time; where it differs or cannot be recorded, those run.
    """

    def __init__(self) -> None:
        self.recorded: Recorded | None = None
        self.key: Hashable = None
        self.left = RECORDINGS

    def __reduce__(self) -> tuple[type[Replay], tuple[()]]:
        return Replay, ()  # a copy's parameters are elsewhere

    def __call__(
        self, terms: Terms, inputs: Sequence[Tensor], parameters: Sequence[Tensor], settings: Hashable = None
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Compute ``terms(*inputs)``.

        Args:
            terms: uses the parameters, and computes the same for the same settings.
            inputs, parameters: ``[...]``, floats; all that has a gradient.
            settings: what else the terms depend on.
        """
        if not (self.left and torch.is_grad_enabled() and may_record(inputs)):
            return terms(*inputs)
        shapes = tuple((each.shape, each.dtype, each.requires_grad) for each in inputs)
        key = (settings, shapes, tuple(parameter.data_ptr() for parameter in parameters))
        if key != self.key:
            found = terms(*inputs)
            if found[0]:
                self._record(key, terms, inputs, parameters)
            return found
        names = self.recorded.names
        values, rest = Replayed.apply(self.recorded, *inputs, *parameters)
        return dict(zip(names, values.unbind(), strict=True)), rest

    def _record(self, key: Hashable, *args: Any) -> None:
        self.left -= 1
        try:
            self.recorded, self.key = Recorded(*args), key
        except Exception as error:  # whatever a driver may say
            self.left = 0
            warnings.warn(f"Losses of the colour transform are not replayed, which is slower: {error}", stacklevel=3)


def may_record(inputs: Sequence[Tensor]) -> bool:
    """Whether tensors ``[...]`` are on a GPU that is not recording already."""
    return inputs[0].is_cuda and not torch.cuda.is_current_stream_capturing()


class Recorded:
    """Terms of one set of shapes, and the gradients of their sum.

    Raises:
        RuntimeError: they cannot be recorded, or what was recorded gives something else.
    """

    def __init__(self, terms: Terms, inputs: Sequence[Tensor], parameters: Sequence[Tensor]):
        self.terms, self.names = terms, ()
        self.inputs = [each.detach().clone().requires_grad_(each.requires_grad) for each in inputs]
        self.wanted = [each for each in (*self.inputs, *parameters) if each.requires_grad]
        self.places = [place for place, each in enumerate((*inputs, *parameters)) if each.requires_grad]
        plain, self.again, self.found = record(self.compute)
        self.again()
        for known, found in zip(plain, self.found, strict=True):
            if not (found - known).norm() <= APART * known.norm():
                raise RuntimeError("what was recorded gives something else")

    @torch.enable_grad()
    def compute(self) -> list[Tensor]:
        """Terms ``[n]``, what else was found, and the gradient of everything wanted."""
        terms, rest = self.terms(*self.inputs)
        self.names = tuple(terms)
        grads = torch.autograd.grad(sum(terms.values()), self.wanted, materialize_grads=True)
        return [torch.stack([*terms.values()]).detach(), rest, *grads]


class Replayed(torch.autograd.Function):
    """What :class:`Recorded` finds for these inputs ``[...]``; parameters come after them, for their gradients."""

    @staticmethod
    def forward(ctx: Any, recorded: Recorded, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        torch._foreach_copy_(recorded.inputs, tensors[: len(recorded.inputs)])
        recorded.again()
        values, rest, *ctx.grads = recorded.found
        ctx.places, ctx.count = recorded.places, len(tensors)
        rest = rest.clone()
        ctx.mark_non_differentiable(rest)
        return values.clone(), rest  # the next replay writes over what was found

    @staticmethod
    def backward(ctx: Any, grad: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        found: list[Tensor | None] = [None] * ctx.count
        for place, each in zip(ctx.places, torch._foreach_mul(ctx.grads, grad[0]), strict=True):
            found[place] = each
        return None, *found


def record(compute: Callable[[], list[Tensor]]) -> tuple[list[Tensor], Callable[[], None], list[Tensor]]:
    """Give what was computed, what computes it again, and where it then is, ``[...]`` each.

    Source: *CUDA graphs*, PyTorch's notes on CUDA semantics.
    """
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):  # libraries take their memory at the first
            plain = compute()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        found = compute()
    return plain, graph.replay, found
