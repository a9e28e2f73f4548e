"""What a training step costs on this machine, part by part, without a colour transform and with it.

``python benchmarks/step.py [backbones=dvgo,nerf] [ctm=auto] [steps=20] [warm_up=N] [slopes=true] [key=value ...]``

Both sides render the same field at rest and the same samples, and take steps in turns. Times are medians, the ratio is
that of the turns. Parts are the host's time, on a GPU too. ``ctm=on`` is compared unless another one is given;
``slopes`` also tells how the cost grows with the batch, the grid and the picture, without a transform. All other keys
are those of a run. Writes ``out``, by default ``benchmark.json``, with what a step hands over to a GPU and waits for.
"""

from __future__ import annotations

import copy
import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import lightning as L
import torch
from hydra.errors import HydraException
from launches import profiled
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from rich.table import Table
from torch.profiler import ProfilerActivity, profile, record_function

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.callbacks.stopwatch import peak_memory_mb, synchronise
from ctm_plugin.color.transform import ColorTransform, fitted
from ctm_plugin.compose.command_line import compose, explain
from ctm_plugin.cpu.allocator import keep_memory
from ctm_plugin.cpu.products import fast_products
from ctm_plugin.errors import ConfigError, CTMError
from ctm_plugin.runs.assemble import Parts, assemble, color_transform
from ctm_plugin.settings.build import build, pairs
from ctm_plugin.settings.setting import setting
from ctm_plugin.show.console import quieten

PARTS = ("sampling", "field", "colour", "loss", "backward", "optimizers")
WARM_UP = {"dvgo": 1400}
"""Training steps before the clock starts; DVGO's free space has to be found. Others: ``FEW``."""
FEW = 20
PROFILED = 8
PICTURES = {16 // down**2: f"dataset.downscale={down}" for down in (4, 2, 1)}
SLOPES: dict[str, dict[str, dict[int, str]]] = {
    "dvgo": {
        "rays": {rays: f"backbone.rays={rays}" for rays in (512, 1024, 2048, 4096)},
        "voxels": {side**3: f"backbone.voxels={side**3}" for side in (48, 64, 96, 128)},
        "pixels of a picture": PICTURES,
    },
    "nerf": {"rays": {rays: f"backbone.rays={rays}" for rays in (64, 128, 256)}, "pixels of a picture": PICTURES},
    "barf2d": {
        "pixels": {pixels: f"backbone.pixels={pixels}" for pixels in (1350, 4050, 12150)},
        "pixels of a picture": {
            parts**2: f"dataset.height={90 * parts} dataset.width={120 * parts} dataset.patch={45 * parts}"
            for parts in (2, 3, 4)
        },
    },
}
"""What is varied for a backbone: sizes, up to a factor, and the overrides that give them."""


@dataclass(frozen=True, kw_only=True)
class StepConfig:
    """What to measure."""

    backbones: str = setting("dvgo,nerf,barf2d", "names, with commas between")
    steps: int = setting(20, "pairs of steps under the clock")
    warm_up: int | None = setting(None, "training steps before; else 1400 for dvgo and 20 for others")
    slopes: bool = setting(False, "also cost against the size of batch, grid and picture")
    out: str = setting("benchmark.json", "file to write")


class Side:
    """A backbone with one transform, and its optimizers; all but the transform's are at rest.

    Args:
        module: no longer a Trainer's.
        transform: takes the place of the module's, unless it is ``None``.
        bf16: run under autocast.
    """

    def __init__(self, module: Backbone, bf16: bool, transform: ColorTransform | None = None):
        self.module, self.bf16 = module, bf16
        if transform is not None:
            module.transform = transform.to(module.device)
        fitted(module.transform, module.some_colors())
        self.optimizers = module.configure_optimizers()
        for name, member in self.optimizers.members.items():
            for group in member.param_groups if name != "ctm" else ():
                group["lr"] = 0.0

    def step(self) -> None:
        """Make one training step."""
        with torch.autocast(self.module.device.type, torch.bfloat16, enabled=self.bf16):
            loss = self.module.training_step(None, 0)["loss"]
        with record_function("ctm/backward"):
            self.optimizers.zero_grad()
            loss.backward()
        with record_function("ctm/optimizers"):
            self.optimizers.step()


def apart(*args: Any) -> dict[str, Any]:
    """Run :func:`measure` in a process of its own, whose memory is its own."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(_measure, *args).result()


def _measure(*args: Any) -> dict[str, Any]:
    try:
        return measure(*args)
    except (HydraException, OmegaConfBaseException, CTMError) as error:
        raise CTMError(explain(error)) from None  # of plain text: others do not cross processes


def measure(
    backbone: str, overrides: Sequence[str], steps: int, warm_up: int | None = None, compared: bool = True
) -> dict[str, Any]:
    """Time a backbone's training step and a view, in this process.

    Args:
        backbone: a name.
        overrides: as on the command line of ``ctm``; its ``ctm`` is what is compared with ``ctm=off``.
        steps: pairs of steps under the clock.
        warm_up: training steps before.
        compared: else only ``ctm=off``.

    Raises:
        CTMError: the configuration cannot be used.
    """
    keep_memory()
    chosen = [f"backbone={backbone}", "ctm=on", "trainer=quick", *overrides]
    on, off = compose(*chosen), compose(*chosen, "ctm=off")
    if on["ctm"].get("name") == "none":
        raise ConfigError("ctm", "off", "a transform to compare with ctm=off")
    parts = assemble(off)
    transform = color_transform(on, on["seed"])
    if transform.channels != parts.backbone.channels:
        raise ConfigError("ctm.k", transform.channels, f"{parts.backbone.channels}: both sides render the same field")
    sides = {"off": None} | ({"on": transform} if compared else {})
    device = warm(parts, WARM_UP.get(backbone, FEW) if warm_up is None else warm_up)
    bf16 = parts.trainer.numbers == "bf16-mixed"
    with fast_products(device):
        found = clock({name: Side(copy.deepcopy(parts.backbone), bf16, each) for name, each in sides.items()}, steps)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    where = {"device": name, "threads": torch.get_num_threads(), "torch": torch.__version__}
    told = {"backbone": backbone, "overrides": list(overrides), "precision": parts.trainer.numbers, **where}
    views = getattr(parts.scene, "test", parts.scene)
    told |= {"view": f"{views.width}x{views.height}", "peak_memory_mb": peak_memory_mb(device)}
    return told | found | {"product_tflops": product_rate(device, bf16)}


def warm(parts: Parts, steps: int) -> torch.device:
    """Train for so many steps; the module is then no Trainer's any more."""
    quieten()
    module = parts.backbone
    trainer = L.Trainer(
        accelerator=parts.trainer.backend, devices=1, max_steps=min(steps, module.total_steps),
        precision=parts.trainer.numbers, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    device = trainer.strategy.root_device
    with fast_products(device):
        trainer.fit(module)
    module.to(device)  # the Trainer has put it on the CPU
    module.trainer = None
    return device


def clock(sides: dict[str, Side], steps: int) -> dict[str, Any]:
    """Time the sides' steps in turns, then their parts and a view: milliseconds and rates by name."""
    times: dict[str, list[float]] = {name: [] for name in sides}
    for step in range(steps + 2):
        # The first with new rays pays for memory of new sizes: they take turns.
        for name in list(sides)[:: 1 if step % 2 else -1]:
            seconds = _seconds(sides[name].step, sides[name].module.device)
            if step >= 2:
                times[name].append(seconds)
    found: dict[str, Any] = {}
    for name, side in sides.items():
        seconds, module = statistics.median(_pairs(times[name])), side.module
        rendering = module.predict(module.draw(module.draws(0)), module.draws(0))
        found[name] = {"step_ms": seconds * 1e3, "parts_ms": parts_of(side, seconds)}
        found[name]["rays_per_second"] = module.batch_rays / seconds
        if samples := getattr(rendering, "samples", None):
            found[name]["samples_per_ray"] = len(samples.t) / module.batch_rays
        view = (
            module.render_image
            if hasattr(module, "render_image")
            else partial(module.render_view, module.scene.test, 0)
        )
        found[name]["view_ms"] = min(_seconds(view, module.device) for _ in range(4)) * 1e3
    for name, side in sides.items():  # when all clocks have stopped
        found[name] |= profiled(side.step, side.module.device, PROFILED)
        found[name]["product_tflops"] = 1e3 * found[name]["product_tflop"] / found[name]["step_ms"]
    return found | ({"ratio": ratio(times["on"], times["off"])} if "on" in found else {})


def _seconds(work: Callable[[], object], device: torch.device) -> float:
    synchronise(device)
    start = time.perf_counter()
    work()
    synchronise(device)
    return time.perf_counter() - start


def product_rate(device: torch.device, bf16: bool) -> float:
    """Measure the TFLOP/s of products of large matrices, which those of a step can be held against."""
    side, times = (8192, 10) if device.type == "cuda" else (512, 1)
    a, b = torch.randn(2, side, side, device=device, dtype=torch.bfloat16 if bf16 else torch.float32)
    seconds = min(_seconds(lambda: [a @ b for _ in range(times)], device) for _ in range(9))
    return 2 * side**3 * times / seconds / 1e12


def ratio(on: Sequence[float], off: Sequence[float]) -> float:
    """Take the median over turns: both sides of one meet the machine at one speed, which changes by the second."""
    return statistics.median(a / b for a, b in zip(_pairs(on), _pairs(off), strict=True))


def _pairs(times: Sequence[float]) -> Sequence[float]:
    """Means of one step as the first and one as the second."""
    return [sum(pair) / 2 for pair in zip(times[::2], times[1::2], strict=False)] or times


def parts_of(side: Side, seconds: float) -> dict[str, float]:
    """Share a step's milliseconds out to its parts: the profiler's shares of the ``seconds`` it took without it.

    By the host's time: on a GPU what it waits for counts where it does.
    """
    with profile(activities=[ProfilerActivity.CPU]) as profiler:
        for _ in range(PROFILED):
            side.step()
            synchronise(side.module.device)
    spans: dict[str, float] = {}
    for event in profiler.key_averages():
        if event.key.startswith("ctm/"):
            spans[event.key[4:]] = max(spans.get(event.key[4:], 0.0), event.cpu_time_total)
    samples = spans.get("samples", 0.0)
    parts = {name: spans.get(name, 0.0) for name in PARTS}
    parts["sampling"], parts["field"] = spans["draw"] + samples, spans["field"] - samples
    whole = sum(parts.values())
    return {name: 1e3 * seconds * part / whole for name, part in parts.items()}


def slopes(backbone: str, overrides: Sequence[str], settings: StepConfig) -> dict[str, Any]:
    """Measure the costs of every size of :data:`SLOPES`, without CTM, and the exponent a of ``cost = b size^a``."""
    found = {}
    for what, choices in SLOPES.get(backbone, {}).items():
        given = (backbone, settings.steps, settings.warm_up)
        runs = [apart(given[0], [*overrides, *each.split()], *given[1:], False) for each in choices.values()]
        costs = {key: [run["off"][key] for run in runs] for key in ("step_ms", "view_ms")}
        costs["peak_memory_mb"] = [run["peak_memory_mb"] for run in runs]
        lines = {
            key: statistics.linear_regression([*map(math.log, choices)], [*map(math.log, cost)])
            for key, cost in costs.items()
        }
        found[what] = {"sizes": list(choices), **costs} | {f"{key}_slope": line.slope for key, line in lines.items()}
    return found


def step_table(result: dict[str, Any]) -> Table:
    """Set out both sides and their ratio: a step's turn by turn, that of the medians elsewhere."""
    table = Table(title="{backbone}, {precision}, {device}, {threads} threads".format(**result))
    table.add_column("")
    for label in ("no CTM", "CTM", "ratio"):
        table.add_column(label, justify="right")
    off, on = result["off"], result["on"]

    def row(label: str, form: str, a: float, b: float) -> None:
        table.add_row(label, form.format(a), form.format(b), f"{b / a:.3f}" if a else "")

    table.add_row("step", f"{off['step_ms']:.2f} ms", f"{on['step_ms']:.2f} ms", f"{result['ratio']:.3f}")
    for part in PARTS:
        row(f"  {part}", "{:.2f} ms", off["parts_ms"][part], on["parts_ms"][part])
    if off["device_ms"]:
        row("kernels and copies", "{:.2f} ms", off["device_ms"], on["device_ms"])
        for what in ("launches", "waits"):
            row(f"{what} of a step", "{:.0f}", sum(off[what].values()), sum(on[what].values()))
        row("products, TFLOP/s", "{:.2f}", off["product_tflops"], on["product_tflops"])
        peak = result["product_tflops"]
        row(f"  of large ones' {peak:.1f}", "{:.1%}", off["product_tflops"] / peak, on["product_tflops"] / peak)
    row("rays per second", "{:,.0f}", off["rays_per_second"], on["rays_per_second"])
    if "samples_per_ray" in off:
        row("samples per ray", "{:.1f}", off["samples_per_ray"], on["samples_per_ray"])
    row("one view of {view}".format(**result), "{:.1f} ms", off["view_ms"], on["view_ms"])
    table.add_row("peak memory of both", "", f"{result['peak_memory_mb']:,.0f} MiB", "")
    return table


def slope_table(found: dict[str, Any]) -> Table:
    """Set out costs by size, and their exponents."""
    table = Table(title="cost against size, no CTM")
    for label in ("", "sizes", "step, ms", "size^", "view, ms", "size^", "MiB", "size^"):
        table.add_column(label, justify="left" if label in ("", "sizes") else "right")
    for what, costs in found.items():
        cells = [what, ", ".join(map(str, costs["sizes"]))]
        for key in ("step_ms", "view_ms", "peak_memory_mb"):
            cells += [", ".join(f"{cost:.0f}" for cost in costs[key]), f"{costs[f'{key}_slope']:.2f}"]
        table.add_row(*cells)
    return table


def main(arguments: Sequence[str]) -> None:
    """Measure, print the tables and write the file."""
    keys = {field.name for field in fields(StepConfig)}
    own = [argument for argument in arguments if argument.partition("=")[0] in keys]
    settings = build(StepConfig, pairs(own), "step")
    others = [argument for argument in arguments if argument not in own]
    console = Console()
    results: dict[str, Any] = {}
    for name in settings.backbones.split(","):
        results[name] = apart(name, others, settings.steps, settings.warm_up)
        console.print(step_table(results[name]))
        if settings.slopes:
            results[name]["slopes"] = slopes(name, others, settings)
            console.print(slope_table(results[name]["slopes"]))
    Path(settings.out).write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    console.print(f"written to {settings.out}", soft_wrap=True)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except CTMError as error:
        sys.exit(f"error: {error}")
