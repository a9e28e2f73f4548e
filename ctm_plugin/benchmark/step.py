"""One backbone under the clock: the same field at rest, with and without CTM, steps taking turns."""

from __future__ import annotations

import copy
import statistics
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import lightning as L
import torch
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException
from torch.profiler import ProfilerActivity, profile, record_function

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.benchmark.counting import counted
from ctm_plugin.benchmark.machine import best_seconds, describe
from ctm_plugin.callbacks.attach_ctm import AttachTransform
from ctm_plugin.callbacks.stopwatch import peak_memory_mb, synchronise
from ctm_plugin.color.transform import fitted
from ctm_plugin.console import quieten
from ctm_plugin.cpu.allocator import keep_memory
from ctm_plugin.cpu.products import fast_products
from ctm_plugin.draws import Draws
from ctm_plugin.errors import ConfigError, CTMError
from ctm_plugin.optim.named_optimizers import NamedOptimizers
from ctm_plugin.runs.assemble import Parts, assemble, color_transform
from ctm_plugin.runs.compose import compose, explain

PARTS = ("sampling", "field", "colour", "loss", "backward", "optimizers")
WARM_UP = {"dvgo": 1400}
"""Training steps before the clock starts; DVGO's free space has to be found. Others: ``FEW``."""
FEW = 20
PROFILED = 8


class Side:
    """A backbone with one transform, and its optimizers.

    Args:
        module: no longer a Trainer's.
        attach: puts the transform in.
        bf16: run under autocast.
    """

    def __init__(self, module: Backbone, attach: AttachTransform, bf16: bool):
        self.module, self.bf16 = module, bf16
        attach.attach(module)
        attach.transform.to(module.device)
        fitted(attach.transform, module.scene_colors(Draws(module.seed, 0, module.device), 1 << 15))
        self.optimizers = module.configure_optimizers()
        rest(self.optimizers)

    def step(self) -> dict[str, Any]:
        """Make one training step; returns what the module's own does."""
        with torch.autocast(self.module.device.type, torch.bfloat16, enabled=self.bf16):
            out = self.module.training_step(None, 0)
        with record_function("ctm/backward"):
            self.optimizers.zero_grad()
            out["loss"].backward()
        with record_function("ctm/optimizers"):
            self.optimizers.step()
        return out


def rest(optimizers: NamedOptimizers) -> None:
    """Hold the field as it is, so that both sides have the same samples throughout."""
    for name, member in optimizers.members.items():
        if name != "ctm":
            for group in member.param_groups:
                group["lr"] = 0.0


def apart(*args: Any) -> dict[str, Any]:
    """Run :func:`measure` in a process of its own, whose memory is its own.

    Raises:
        CTMError: the configuration cannot be used.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(_measure, *args).result()


def _measure(*args: Any) -> dict[str, Any]:
    try:
        return measure(*args)
    except (HydraException, OmegaConfBaseException, CTMError) as error:
        raise CTMError(explain(error)) from None  # of plain text: others do not cross processes


def measure(
    backbone: str, overrides: Sequence[str], steps: int, warm_up: int | None = None, alone: bool = False
) -> dict[str, Any]:
    """Time a backbone's training step and a view, in this process.

    Args:
        backbone: a name.
        overrides: as on the command line of ``ctm_plugin``; ``ctm`` is what is compared with ``ctm=off``.
        steps: pairs of steps under the clock.
        warm_up: training steps before.
        alone: without CTM alone.

    Raises:
        CTMError: the configuration cannot be used.
    """
    keep_memory()
    chosen = [f"backbone={backbone}", "ctm=on", "trainer=quick", *overrides]
    on, off = compose(*chosen), compose(*chosen, "ctm=off")
    if on["ctm"].get("name") == "none":
        raise ConfigError("ctm", "off", "a transform to compare with ctm=off")
    parts = assemble(off)
    transform, training = color_transform(on, on["seed"])
    if transform.channels != parts.backbone.channels:
        raise ConfigError("ctm.k", transform.channels, f"{parts.backbone.channels}: both sides render the same field")
    attach = {"off": parts.attach, "on": AttachTransform(transform, training)}
    device, bf16 = warm(parts, WARM_UP.get(backbone, FEW) if warm_up is None else warm_up)
    with fast_products(device):
        names = ("off",) if alone else ("off", "on")
        sides = {name: Side(copy.deepcopy(parts.backbone), attach[name], bf16) for name in names}
        result = {"backbone": backbone, "overrides": overrides, "precision": parts.trainer.numbers}
        result |= clock(sides, steps, device)
        result["peak_memory_mb"] = peak_memory_mb(device)  # before the square products of ``describe``
        result["machine"] = describe(device)
    return result


def warm(parts: Parts, steps: int) -> tuple[torch.device, bool]:
    """Train for so many steps; the module is then no Trainer's any more."""
    quieten()
    module = parts.backbone
    trainer = L.Trainer(
        accelerator=parts.trainer.backend, devices=1, max_steps=min(steps, module.total_steps),
        precision=parts.trainer.numbers, callbacks=[parts.attach], logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    device = trainer.strategy.root_device
    with fast_products(device):
        trainer.fit(module)
    module.to(device)  # the Trainer has put it on the CPU
    module.trainer = None
    return device, parts.trainer.numbers == "bf16-mixed"


def clock(sides: dict[str, Side], steps: int, device: torch.device) -> dict[str, Any]:
    """Time the sides' steps in turns; then their parts, FLOPs, bytes and a view: milliseconds and rates by name."""
    times: dict[str, list[float]] = {name: [] for name in sides}
    for step in range(steps + 2):
        # Whoever comes first with new rays pays for memory of new sizes: they take turns.
        for name in list(sides)[:: 1 if step % 2 else -1]:
            synchronise(device)
            start = time.perf_counter()
            sides[name].step()
            synchronise(device)
            if step >= 2:
                times[name].append(time.perf_counter() - start)
    found: dict[str, Any] = {}
    for name, side in sides.items():
        seconds = statistics.median(_pairs(times[name]))
        module = side.module
        with counted() as counts:
            side.step()
        points = module.points(module.predict(module.draw(module.draws(0)), module.draws(0)))
        found[name] = {
            "step_ms": seconds * 1e3,
            "parts_ms": parts_of(side, seconds, device),
            "rays_per_second": module.batch_rays / seconds,
            "points_per_ray": points / module.batch_rays,
            "flops": counts.flops,
            "flops_per_second": counts.flops / seconds,
            "bytes": counts.bytes,
            "bytes_per_second": counts.bytes / seconds,
        }
        view = module.whole_picture()
        if view is not None:
            found[name]["view_ms"] = best_seconds(view, device, 3) * 1e3
    return found | ({"ratio": ratio(times["on"], times["off"])} if "on" in found else {})


def ratio(on: Sequence[float], off: Sequence[float]) -> float:
    """Take the median over turns: both sides of one meet the machine at one speed, which changes by the second."""
    return statistics.median(a / b for a, b in zip(_pairs(on), _pairs(off), strict=True))


def _pairs(times: Sequence[float]) -> Sequence[float]:
    """Means of one step as the first and one as the second."""
    return [sum(pair) / 2 for pair in zip(times[::2], times[1::2], strict=False)] or times


def parts_of(side: Side, seconds: float, device: torch.device) -> dict[str, float]:
    """Share a step's milliseconds out to its parts: the profiler's shares of the ``seconds`` it took without it.

    By the host's time: on a GPU what it waits for counts where it does.
    """
    with profile(activities=[ProfilerActivity.CPU]) as profiler:
        for _ in range(PROFILED):
            side.step()
            synchronise(device)
    spans: dict[str, float] = {}
    for event in profiler.key_averages():
        if event.key.startswith("ctm/"):
            spans[event.key[4:]] = max(spans.get(event.key[4:], 0.0), event.cpu_time_total)
    samples = spans.get("samples", 0.0)
    parts = {name: spans.get(name, 0.0) for name in PARTS}
    parts["sampling"], parts["field"] = spans["draw"] + samples, spans["field"] - samples
    whole = sum(parts.values())
    return {name: 1e3 * seconds * part / whole for name, part in parts.items()}
