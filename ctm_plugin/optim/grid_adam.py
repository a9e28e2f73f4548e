"""Adam that updates only the voxels with a gradient."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from ctm_plugin.door import looped


class GridAdam(Optimizer):
    """Adam for tables of voxels ``[voxels, channels]``: rows without gradient are neither stepped nor decayed.

    Adam's moments of a voxel that no ray saw would go on moving it; in DVGO such voxels rest (its ``MaskedAdam``).
    A group may hold ``rates``, one factor a voxel on the learning rate (DVGO's view counts, ``[voxels, 1]``).

    On the CPU (in float32) only the touched rows are read and written, and a sparse gradient says which they are;
    elsewhere the whole table is updated under a mask, without a synchronisation. Sparse or dense, the loop gives the
    same bits; the mask gives the same numbers to rounding.
    """

    def __init__(self, params, lr: float = 0.1, betas: tuple[float, float] = (0.9, 0.99), eps: float = 1e-8):
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps, "rates": None})

    @torch.no_grad()
    def step(self, closure: None = None) -> None:
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._step_table(parameter, group)

    def _step_table(self, table: Tensor, group: dict[str, Any]) -> None:
        state = self.state[table]
        if not state:
            state["step"] = 0
            state["exp_avg"] = torch.zeros_like(table)
            state["exp_avg_sq"] = torch.zeros_like(table)
        state["step"] += 1
        moments = state["exp_avg"], state["exp_avg_sq"]
        step_table(table, table.grad, *moments, group["rates"], state["step"], *map(group.get, ("lr", "betas", "eps")))

    def state_dict(self) -> dict[str, Any]:
        """Give the state of the base class without ``rates``, which follow from the data."""
        saved = super().state_dict()
        for group in saved["param_groups"]:
            group["rates"] = None
        return saved

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        rates = [group["rates"] for group in self.param_groups]
        super().load_state_dict(state_dict)
        for group, rate in zip(self.param_groups, rates, strict=True):
            group["rates"] = rate


@looped("adam:step_table", kernel="adam:step_table")
def step_table(
    table: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, rates: Tensor | None, step: int,
    lr: float, betas: tuple[float, float], eps: float,
) -> None:  # fmt: skip
    """Make one step of :class:`GridAdam`, in place; rows of zeros in the gradient rest.

    Args:
        table, exp_avg, exp_avg_sq: ``[V, c]``, and Adam's moments of it.
        grad: ``[V, c]``, sparse or dense.
        rates: ``[V, 1]``, factors on the step; ``None``: 1.
        step: how many steps there are with this one.
        lr, betas, eps: Adam's.
    """
    grad, (beta1, beta2) = grad.to_dense() if grad.is_sparse else grad, betas
    correction1, correction2 = 1 - beta1**step, (1 - beta2**step) ** 0.5
    seen = (grad != 0).any(1, keepdim=True)
    torch.where(seen, exp_avg.lerp(grad, 1 - beta1), exp_avg, out=exp_avg)
    torch.where(seen, exp_avg_sq.lerp(grad.square(), 1 - beta2), exp_avg_sq, out=exp_avg_sq)
    change = exp_avg / (exp_avg_sq.sqrt() / correction2 + eps) * (-lr / correction1)
    table.add_(torch.where(seen, change if rates is None else change * rates, 0.0))
