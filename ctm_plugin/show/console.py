"""Tables in the terminal: a short one at the end of a run or a sweep."""

from __future__ import annotations

import logging
import shlex
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.style import Style
from rich.table import Table
from rich.text import Text

from ctm_plugin.metrics.evaluate import no_measurement
from ctm_plugin.metrics.table import METRICS, told_at

PATHS = {
    "lit views": "lit", "film of the training": "film.gif", "scores": "metrics.json",
    "checkpoint": "checkpoints/last.ckpt", "TensorBoard": "tensorboard",
}  # fmt: skip


def output_console() -> Console:
    """Open standard output as a console, of a terminal's width, or of unlimited width elsewhere."""
    console = Console()
    return console if console.is_terminal else Console(width=10_000)


def table_for(console: Console, **settings: Any) -> Table:
    """Make an empty table, with ruled lines on a terminal, as columns of plain text elsewhere."""
    return Table(box=box.HEAVY_HEAD if console.is_terminal else None, **settings)


def texts(metrics: dict[str, Any], place: str) -> dict[str, str]:
    """Format the scores that are shown at a place (see :func:`told_at`) as text, by their names."""
    alike = metrics.get("appearance") == "none"
    entries = {name: metric for name, metric in told_at(place).items() if not (alike and metric.differing)}
    return {name: metric.text(metrics[name]) for name, metric in entries.items() if metrics.get(name) is not None}


def print_next(verb: str, path: Path) -> None:
    """Print the command that comes next, as it can be pasted."""
    output_console().print(f"next: ctm {verb} {shlex.quote(str(path))}", soft_wrap=True, highlight=False, markup=False)


def print_file(before: str, path: Path) -> None:
    """Print a file's path, on a terminal as a link that opens it."""
    link = Style(link=path.resolve().as_uri())
    output_console().print(Text.assemble(before, (str(path), link)), soft_wrap=True)


def print_summary(metrics: dict[str, Any], folder: Path, run: Path | None = None) -> None:
    """Print a run's scores, its time and memory, and the folder of its files, if that is not the run's own."""
    console = output_console()
    table = table_for(console, show_header=False)
    for name, text in texts(metrics, "run").items():
        table.add_row(METRICS[name].label, text)
    if metrics.get("converged") is False:
        table.add_row("not converged", "within 1 dB of one constant colour")
    if metrics.get("measured") is False:
        table.add_row("budget", no_measurement(metrics["steps"]))
    for label, name in PATHS.items():
        if (folder / name).exists():
            table.add_row(label, name)
    title = f"{metrics['dataset']} · {metrics['backbone']} · ctm={metrics['ctm']} · seed {metrics['seed']}"
    console.print(title, soft_wrap=True, highlight=False, markup=False)
    console.print(table)
    console.print(f"written to {folder}", soft_wrap=True, markup=False)
    print_next("view", run or folder)


def print_line(metrics: dict[str, Any], folder: Path, before: str = "") -> None:
    """Print one run of a sweep in one line."""
    parts = [f"{METRICS[name].label} {text}" for name, text in texts(metrics, "sweep").items()]
    if metrics.get("converged") is False:
        parts.append("not converged")
    line = "  ".join([*parts, f"written to {folder}"])
    output_console().print(f"{before}{line}", soft_wrap=True, highlight=False, markup=False)


def print_sweep(runs: Sequence[tuple[str, dict[str, Any] | None]], folder: Path) -> None:
    """Print a line a run of a sweep: the settings that set it apart, and its scores; ``None`` where it failed."""
    console = output_console()
    rows = [(what, None if metrics is None else texts(metrics, "sweep")) for what, metrics in runs]
    shown = [name for name in told_at("sweep") if any(scores and name in scores for _, scores in rows)]
    table = table_for(console)
    table.add_column("", justify="right")
    table.add_column("run", overflow="fold")
    for name in shown or ("psnr",):
        table.add_column(METRICS[name].label, justify="right")
    for number, (what, scores) in enumerate(rows):
        outcome = ["failed"] if scores is None else [scores.get(name, "-") for name in shown]
        table.add_row(str(number), Text(what), *outcome)
    console.print(f"{len(runs)} runs in {folder}", soft_wrap=True, markup=False)
    console.print(table)
    if any(scores for _, scores in rows):
        print_next("report", folder)


def quieten() -> None:
    """Silence Lightning's advice on data loaders and its list of devices, which are not for our users."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in (
        ".*does not have many workers.*",
        ".*`val_dataloader`.*",
        ".*number of training batches.*",
        ".*your dataloader is not resumable.*",  # its batches are empty, see Backbone.train_dataloader
        ".*LeafSpec.*",
        ".*`broadcast_buffers` is deprecated.*",
    ):
        warnings.filterwarnings("ignore", message, module="lightning.*")
