"""Optimizers: several by name behind one step, and Adam that leaves untouched voxels alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from ctm_plugin.cpu.door import looped

Schedule = Callable[[int], float]
"""Factor on a learning rate after so many optimizer steps."""


def exponential(factor: float, steps: int) -> Schedule:
    """``factor ** (step / steps)``: ``factor`` is reached after ``steps`` steps."""
    return lambda step: factor ** (step / steps)


class NamedOptimizers(Optimizer):
    """Independent optimizers stepped together, each with its own class, hyper-parameters, schedule and state.

    A Lightning Trainer sees one optimizer, so that one batch is one ``global_step`` and accumulation, clipping and
    gradient scaling are the Trainer's; yet each member stays what it is: ``state_dict()`` holds the members' by name,
    and every parameter group carries its member's name for the learning-rate monitor.

    Args:
        members: optimizers by name. They must not share parameters.
        schedules: learning-rate factors by member; a member without one keeps its rate.

    Example:
        >>> field, ctm = torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)
        >>> members = {"field": torch.optim.SGD(field.parameters()), "ctm": torch.optim.Adam(ctm.parameters())}
        >>> sorted(NamedOptimizers(members).state_dict())
        ['ctm', 'field']
    """

    def __init__(self, members: Mapping[str, Optimizer], schedules: Mapping[str, Schedule] | None = None):
        self.members = dict(members)
        self.schedules = dict(schedules or {})
        super().__init__(self._label_groups(), {})

    def _label_groups(self) -> list[dict[str, Any]]:
        groups = []
        for name, member in self.members.items():
            for group in member.param_groups:
                group.setdefault("initial_lr", group["lr"])
                label = group.get("name")
                if label is None:
                    group["name"] = name
                elif label != name and not label.startswith(f"{name}/"):
                    group["name"] = f"{name}/{label}"
                groups.append(group)
        return groups

    def replace(self, name: str, member: Optimizer) -> None:
        """Put another optimizer in a member's place; the others keep their state."""
        self.members[name] = member
        self.param_groups[:] = self._label_groups()

    def set_rates(self, step: int) -> None:
        """Set each member's learning rates to ``initial_lr * schedule(step)``."""
        for name, schedule in self.schedules.items():
            factor = schedule(step)
            for group in self.members[name].param_groups:
                group["lr"] = group["initial_lr"] * factor

    @property
    def state(self) -> dict[Tensor, Any]:
        """The members' states in one dict (a view for reading: the members own them)."""
        return {parameter: state for member in self.members.values() for parameter, state in member.state.items()}

    @state.setter
    def state(self, value: object) -> None:
        """The base class assigns an empty state; the members already have theirs."""

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Step every member once, after one evaluation of the closure."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for member in self.members.values():
            member.step()
        return loss

    def zero_grad(self, set_to_none: bool = True) -> None:
        for member in self.members.values():
            member.zero_grad(set_to_none)

    def state_dict(self) -> dict[str, Any]:
        return {name: member.state_dict() for name, member in self.members.items()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore every member.

        Raises:
            KeyError: if the names differ from the members'.
            ValueError: a parameter's moments have another shape than the parameter.
        """
        if state_dict.keys() != self.members.keys():
            raise KeyError(f"optimizers {sorted(state_dict)} in the checkpoint, {sorted(self.members)} in the model")
        for name, member in self.members.items():
            member.load_state_dict(state_dict[name])
        for parameter, state in self.state.items():
            for key in ("exp_avg", "exp_avg_sq"):  # loops do not look
                if key in state and state[key].shape != parameter.shape:
                    raise ValueError(f"{key} of shape {list(state[key].shape)} for one of {list(parameter.shape)}")
        self.param_groups[:] = self._label_groups()


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
        """As the base class's; ``rates`` follow from the data and are not saved."""
        saved = super().state_dict()
        for group in saved["param_groups"]:
            group["rates"] = None
        return saved

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        rates = [group["rates"] for group in self.param_groups]
        super().load_state_dict(state_dict)
        for group, rate in zip(self.param_groups, rates, strict=True):
            group["rates"] = rate


@looped("adam:step_table")
def step_table(
    table: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, rates: Tensor | None, step: int,
    lr: float, betas: tuple[float, float], eps: float,
) -> None:  # fmt: skip
    """One step of :class:`GridAdam`, in place; rows of zeros in the gradient rest."""
    grad, (beta1, beta2) = grad.to_dense() if grad.is_sparse else grad, betas
    correction1, correction2 = 1 - beta1**step, (1 - beta2**step) ** 0.5
    seen = (grad != 0).any(1, keepdim=True)
    torch.where(seen, exp_avg.lerp(grad, 1 - beta1), exp_avg, out=exp_avg)
    torch.where(seen, exp_avg_sq.lerp(grad.square(), 1 - beta2), exp_avg_sq, out=exp_avg_sq)
    change = exp_avg / (exp_avg_sq.sqrt() / correction2 + eps) * (-lr / correction1)
    table.add_(torch.where(seen, change if rates is None else change * rates, 0.0))
