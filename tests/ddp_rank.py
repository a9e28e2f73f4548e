"""One process of several: the command line, then this process' steps and weights into a file.

And what one process alone makes of the same steps, each from the state that the several began it with: where trainings
part by rounding, steps do not.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

if "CTM_REORDERED" in os.environ:
    import reordered  # noqa: F401
from ctm_plugin import cli
from ctm_plugin.callbacks.checkpoint import RunInfo
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.load import restore
from ctm_plugin.settings.build import Config

APART = 1e-3
"""Of their norm, gradients and sums of a step may differ by this between one process and several."""
COUNTED = ("grad2d", "grad2d_count")
"""What is summed over processes besides gradients."""


def main(arguments: list[str]) -> int:
    """The command line after a folder for ``rank*.pt``."""
    steps: list[dict[str, Any]] = []

    def copied(tensors: Iterator[tuple[str, Tensor]]) -> dict[str, Tensor]:
        return {name: each.detach().clone() for name, each in tensors}

    def begin(self: RunInfo, trainer: Any, module: Any, optimizer: Any) -> None:
        steps.append({"state_dict": copied(module.state_dict().items()), "terms": [], "step": trainer.global_step})
        module.on_save_checkpoint(steps[-1])
        steps[-1]["batches_seen"] -= 1  # the first batch's loss is there, its gradient is not

    def note(self: RunInfo, trainer: Any, module: Any, loss: Tensor) -> None:
        steps[-1]["terms"].append(module.terms)

    def end(self: RunInfo, trainer: Any, module: Any, optimizer: Any) -> None:
        steps[-1]["found"] = copied(gradients(module))

    def save(self: RunInfo, trainer: Any, module: Any) -> None:
        parts = {"weights": module.state_dict(), "optimizer": module.named_optimizers.state_dict()}
        torch.save(parts | {"batches": module.batches_seen, "steps": steps}, out)

    out = Path(arguments[0]) / f"rank{os.environ.get('LOCAL_RANK', 0)}.pt"
    hooks = {"on_before_zero_grad": begin, "on_before_backward": note, "on_before_optimizer_step": end}
    for name, hook in (hooks | {"on_train_end": save}).items():
        setattr(RunInfo, name, hook)
    return cli.main(arguments[1:])


def gradients(module: torch.nn.Module) -> Iterator[tuple[str, Tensor]]:
    """And what else a step sums up over processes."""
    yield from ((name, each.grad) for name, each in module.named_parameters() if each.grad is not None)
    yield from ((name, each) for name, each in module.named_buffers() if name in COUNTED)


def apart(config: Config, steps: list[dict[str, Any]]) -> float:
    """How far a step's gradients are from those of one process, of their norm; losses are the same but for rounding.

    Args:
        config: the run's, for one process.
        steps: what ``main`` notes of one step, of all processes; or of one, whose losses are then not looked at.
    """
    parts, batches = assemble(config), len(steps[0]["terms"])
    module = parts.backbone
    restore(parts, steps[0], Path())
    alone = {"global_rank": 0, "world_size": 1, "accumulate_grad_batches": batches}
    module._trainer = SimpleNamespace(global_step=steps[0]["step"], state=SimpleNamespace(fn="fit"), **alone)
    if hasattr(module, "renew_pool"):
        module.renew_pool()
    for batch in range(batches):
        (module.training_step(None, 0)["loss"] / batches).backward()
        module.on_after_backward()
        each = [step["terms"][batch] for step in steps]
        assert module.terms.keys() == each[0].keys()
        for name, term in module.terms.items() if len(each) > 1 else ():
            torch.testing.assert_close(sum(terms[name] for terms in each) / len(each), term, rtol=APART, atol=1e-6)
    found = {name: each.to_dense() for name, each in gradients(module)}
    assert found.keys() == steps[0]["found"].keys()
    return max(
        float((each - steps[0]["found"][name]).norm() / each.norm().clamp_min(1e-12)) for name, each in found.items()
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
