"""Several optimizers by name behind one step."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from ctm_plugin.optim.schedules import Schedule


def leave_out(optimizer: Optimizer, others: Collection[Tensor]) -> None:
    """Take parameters ``[...]`` out of an optimizer that has not stepped, and groups that are empty then."""
    for group in optimizer.param_groups:
        group["params"] = [parameter for parameter in group["params"] if parameter not in others]
        group.pop("param_names", None)  # of ``Adam(self.named_parameters())``: other members have none
    optimizer.param_groups[:] = [group for group in optimizer.param_groups if group["params"]]


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

    def exchange(self, old: Tensor, new: Tensor) -> dict[str, Any]:
        """Put a parameter ``new`` ``[...]`` in the place of ``old`` ``[...]``; give the state that it takes over."""
        for member in self.members.values():
            for group in member.param_groups:
                group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
            if old in member.state:
                member.state[new] = member.state.pop(old)
        return self.state.get(new, {})

    def set_rates(self, step: int | float) -> None:
        """Set each member's learning rates to ``initial_lr * schedule(step)``."""
        for name, schedule in self.schedules.items():
            factor = schedule(step)
            for group in self.members[name].param_groups:
                group["lr"] = group["initial_lr"] * factor

    @property
    def state(self) -> dict[Tensor, Any]:
        """Give the members' states in one dict (a view for reading: the members own them)."""
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
