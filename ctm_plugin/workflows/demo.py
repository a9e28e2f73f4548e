"""The dark still life in plain colours, with the paper's CTM and with the recommended colours, side by side."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from shutil import which
from typing import Any

from PIL import Image
from rich.console import Console
from rich.table import Table

from ctm_plugin.compose.command_line import compose
from ctm_plugin.data.readers.images import to_8_bits
from ctm_plugin.export.page import html, picture_url
from ctm_plugin.files import write_text
from ctm_plugin.metrics.table import Metric, told_at
from ctm_plugin.runs.load import load_run
from ctm_plugin.runs.rundir import PAGE
from ctm_plugin.runs.train import train
from ctm_plugin.scene.views import composite
from ctm_plugin.show.console import output_console, print_file, print_next, table_for
from ctm_plugin.show.pictures import depth_picture

DEMO_LABELS = {"off": "no CTM", "quick": "CTM", "auto": "ctm=auto"}
"""Labels of the transforms that the demo trains."""


def demo(others: Sequence[str] = ()) -> None:
    """Train on the dark still life in plain colours, with the paper's CTM and with ``ctm=auto``, minutes on a laptop.

    Prints their scores, and writes index.html, where they are side by side, into a folder below runs/.

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
    write_demo({ctm: folder / f"ctm_{ctm}" for ctm in DEMO_LABELS}, results, folder / PAGE)
    console.print(f"{results['off']['dataset']}, {results['off']['steps']} steps", highlight=False)
    console.print(comparison(console, results))
    console.print(advice(results), highlight=False, markup=False)
    print_file("side by side: ", folder / PAGE)
    if which("ctm") is None:
        activate = os.path.relpath(Path(sys.prefix, "bin", "activate"))
        console.print(f"next: source {activate}, then", soft_wrap=True, highlight=False, markup=False)
    print_next("view", folder / "ctm_auto")
    print_next("photos", Path("FOLDER"))


def comparison(console: Console, results: dict[str, dict]) -> Table:
    """Table with a row of scores for each run, and its differences from the first run."""
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


def write_demo(runs: Mapping[str, Path], results: Mapping[str, Mapping[str, Any]], path: Path, view: int = 3) -> None:
    """Write a page with one test view of each run, lit, under its photograph, and its depth."""
    shots = []
    for ctm, run in runs.items():
        module = load_run(run).module
        scene, score = module.scene, results[ctm]["psnr_enhanced"]
        out = {name: value.float().cpu() for name, value in module.render_view(scene.test, view).items()}
        taken = composite(scene.test.images[view], module.constant_background().cpu())
        pictures = {"lit": module.light.apply(out["rgb"]), "taken": taken, "photo": module.light.apply(taken)}
        pictures["depth"] = depth_picture(out["depth"], scene.near, scene.far)
        urls = {kind: picture_url(Image.fromarray(to_8_bits(each).numpy())) for kind, each in pictures.items()}
        shots.append({"name": DEMO_LABELS[ctm], "score": f"brightened PSNR {score:.2f} dB", **urls})
    size = (scene.test.width, scene.test.height)
    template = Path(__file__).with_name("demo.html.jinja")
    write_text(path, html(template, name="In the dark, three times", size=size, told=advice(results), shots=shots))


def advice(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Word which run is closest to the photographs when lit, and whether its transform is the default."""
    best = max(results, key=lambda ctm: results[ctm]["psnr_enhanced"])
    default = "the default" if best == "auto" else "though ctm=auto is the default"
    return f"Closest to the photographs here: ctm={best}, {default}."


def _text(value: float | None, metric: Metric, sign: str = "") -> str:
    """Text of a score without its unit, to three decimals at most."""
    if value is None:
        return "-"
    number = f"{value:{sign}.{min(metric.decimals, 3)}f}"
    return number if metric.of else f"{number} {metric.unit}"
