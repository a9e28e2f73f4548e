"""What a step costs, as tables and as a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from ctm_plugin.benchmark.slopes import SLOPES, slope
from ctm_plugin.benchmark.step import PARTS, apart
from ctm_plugin.files import write_json
from ctm_plugin.settings.build import setting


@dataclass(frozen=True, kw_only=True)
class BenchmarkConfig:
    """What to measure."""

    backbones: str = setting("dvgo,nerf,barf2d", "names, with commas between")
    steps: int = setting(20, "pairs of steps under the clock")
    warm_up: int | None = setting(None, "training steps before; else 1400 for dvgo and 20 for others")
    slopes: bool = setting(False, "also cost against the size of batch, grid and picture")
    out: str = setting("benchmark.json", "file to write")


def benchmark(settings: BenchmarkConfig, others: Sequence[str]) -> None:
    """Measure a training step of each backbone, part by part, without CTM and with it: tables, and a JSON file.

    Steps without and with take turns on the same samples; times are medians, and the ratio is that of the turns. The
    parts are the host's time, on a GPU too. ``ctm=on`` is compared where no other ``ctm`` is given.

    Raises:
        CTMError: a configuration cannot be used.
    """
    console = Console()
    results: dict[str, Any] = {}
    for name in settings.backbones.split(","):
        console.print(f"[bold]{name}[/bold] ...")
        results[name] = apart(name, others, settings.steps, settings.warm_up)
        console.print(step_table(results[name]))
        if settings.slopes:
            results[name]["slopes"] = slopes(name, others, settings.steps, settings.warm_up)
            console.print(slope_table(results[name]["slopes"]))
    write_json(Path(settings.out), results)
    console.print(f"written to {settings.out}", soft_wrap=True)


def slopes(backbone: str, overrides: Sequence[str], steps: int, warm_up: int | None) -> dict[str, Any]:
    """Measure the costs of every size of :data:`SLOPES`, without CTM, and their exponents."""
    found = {}
    for what, choices in SLOPES.get(backbone, {}).items():
        runs = [apart(backbone, [*overrides, *given.split()], steps, warm_up, True) for given in choices.values()]
        costs = {key: [run["off"][key] for run in runs] for key in ("step_ms", "view_ms")}
        costs["peak_memory_mb"] = [run["peak_memory_mb"] for run in runs]
        sizes = list(choices)
        found[what] = {"sizes": sizes, **costs} | {f"{key}_slope": slope(sizes, cost) for key, cost in costs.items()}
    return found


def step_table(result: dict[str, Any]) -> Table:
    """Set out both sides and their ratio: a step's turn by turn, that of the medians elsewhere."""
    machine = result["machine"]
    title = f"{result['backbone']}, {result['precision']}, {machine['device']}, {machine['threads']} threads"
    table = Table(title=title)
    table.add_column("")
    for label in ("no CTM", "CTM", "ratio"):
        table.add_column(label, justify="right")
    off, on = result["off"], result["on"]

    def row(label: str, form: str, a: float, b: float) -> None:
        table.add_row(label, form.format(a), form.format(b), f"{b / a:.3f}" if a else "")

    table.add_row("step", f"{off['step_ms']:.2f} ms", f"{on['step_ms']:.2f} ms", f"{result['ratio']:.3f}")
    for part in PARTS:
        row(f"  {part}", "{:.2f} ms", off["parts_ms"][part], on["parts_ms"][part])
    row("rays per second", "{:,.0f}", off["rays_per_second"], on["rays_per_second"])
    row("points per ray", "{:.1f}", off["points_per_ray"], on["points_per_ray"])
    for kind in ("float32",) if result["precision"] == "32-true" else ("float32", "bfloat16"):
        peak = machine[f"{kind}_flops"]
        row(f"of {peak / 1e9:,.0f} GFLOP/s in {kind}", "{:.1%}", *(s["flops_per_second"] / peak for s in (off, on)))
    copy = machine["copy_bytes_per_second"]
    row(f"of {copy / 1e9:,.1f} GB/s copied", "{:.1%}", *(s["bytes_per_second"] / copy for s in (off, on)))
    if "view_ms" in off:
        row("one view", "{:.0f} ms", off["view_ms"], on["view_ms"])
    table.add_row("peak memory of both", "", f"{result['peak_memory_mb']:,.0f} MiB", "")
    return table


def slope_table(found: dict[str, Any]) -> Table:
    """Set out costs by size, and the exponent a of cost ~ size^a."""
    table = Table(title="cost against size, no CTM")
    for label in ("", "sizes", "step, ms", "size^", "view, ms", "size^", "MiB", "size^"):
        table.add_column(label, justify="left" if label in ("", "sizes") else "right")
    for what, costs in found.items():
        cells = [what, ", ".join(map(str, costs["sizes"]))]
        for key in ("step_ms", "view_ms", "peak_memory_mb"):
            cells += [", ".join(f"{cost:.0f}" for cost in costs[key]), f"{costs[f'{key}_slope']:.2f}"]
        table.add_row(*cells)
    return table
