"""The dark still life in plain colours, with the paper's CTM and with the recommended colours, side by side."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from shutil import which

from rich.console import Console
from rich.table import Table

from ctm_plugin.metrics.table import Metric, told_at
from ctm_plugin.runs.compose import compose
from ctm_plugin.runs.load import load_run
from ctm_plugin.runs.train import train
from ctm_plugin.scene.views import composite
from ctm_plugin.show.console import output_console, print_next, table_for
from ctm_plugin.show.pictures import below, beside, depth_picture, labelled, write_png

DEMO_LABELS = {"off": "no CTM", "quick": "CTM", "auto": "ctm=auto"}
"""Labels of the transforms that the demo trains."""


def demo(others: Sequence[str] = ()) -> None:
    """Train on the dark still life in plain colours, with the paper's CTM and with ``ctm=auto``, minutes on a laptop.

    Prints their scores, and writes side_by_side.png into a folder below runs/.

    Args:
        others: choices and keys for all runs.
    """
    folder = Path("runs") / f"demo_{time.strftime('%Y-%m-%d_%H-%M-%S')}"
    console = output_console()
    configs = {ctm: compose(f"ctm={ctm}", "trainer=quick", *others) for ctm in DEMO_LABELS}
    results = {}
    for ctm, config in configs.items():
        console.print(f"\n[bold]ctm={ctm}[/bold]")
        results[ctm] = train(config, folder / f"ctm_{ctm}")
    picture = folder / "side_by_side.png"
    side_by_side([folder / f"ctm_{ctm}" for ctm in DEMO_LABELS], picture)
    console.print(f"{results['off']['dataset']}, {results['off']['steps']} steps", highlight=False)
    console.print(comparison(console, results))
    console.print(f"picture: {picture}", soft_wrap=True, highlight=False, markup=False)
    if which("ctm") is None:
        activate = os.path.relpath(Path(sys.prefix, "bin", "activate"))
        console.print(f"next: source {activate}, then", soft_wrap=True, highlight=False, markup=False)
    print_next("view", folder / "ctm_auto")
    print_next("photos", Path("FOLDER"))


def comparison(console: Console, results: dict[str, dict]) -> Table:
    """A row a run, and what each is above or below the first."""
    metrics, table = told_at("demo"), table_for(console)
    table.add_column("")
    for metric in metrics.values():
        table.add_column(metric.brief or metric.label, justify="right")
    (first, base), *others = results.items()
    for ctm, row in results.items():
        table.add_row(DEMO_LABELS[ctm], *[_text(row[key], metric) for key, metric in metrics.items()])
    for ctm, row in others:
        apart = [None if base[key] is None or row[key] is None else row[key] - base[key] for key in metrics]
        differences = [_text(value, metrics[key], "+") for key, value in zip(metrics, apart, strict=True)]
        table.add_row(f"{DEMO_LABELS[ctm]} - {DEMO_LABELS[first]}", *differences)
    return table


def side_by_side(runs: Sequence[Path], path: Path, view: int = 3) -> None:
    """One test view of some runs, lit, and its depth, twice as large; the photograph first."""
    columns, names = [], ["photograph, lit"]
    for run in runs:
        loaded = load_run(run)
        module, ctm = loaded.module, loaded.config["ctm"]["preset"]
        names.append(DEMO_LABELS.get(ctm, f"ctm={ctm}"))
        scene = module.scene
        out = {name: value.float().cpu() for name, value in module.render_view(scene.test, view).items()}
        columns.append([module.light.apply(out["rgb"]), depth_picture(out["depth"], scene.near, scene.far)])
    target = composite(scene.test.images[view], module.constant_background().cpu())
    depth, nothing = scene.test.depth, target.new_full(target.shape[:2], scene.far)
    truth = nothing if depth is None else depth[view].nan_to_num(scene.far)
    columns.insert(0, [module.light.apply(target), depth_picture(truth, scene.near, scene.far)])
    larger = [below(*column).repeat_interleave(2, 0).repeat_interleave(2, 1) for column in columns]
    write_png(path, beside(*[labelled(column, name) for column, name in zip(larger, names, strict=True)], gap=4))


def _text(value: float | None, metric: Metric, sign: str = "") -> str:
    """Scores without their units, to three decimals at most."""
    if value is None:
        return "-"
    number = f"{value:{sign}.{min(metric.decimals, 3)}f}"
    return number if metric.of else f"{number} {metric.unit}"
