"""What a person reads in the terminal: the short table at the end of a run, and nothing of the libraries' own."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

ROWS = {
    "psnr": ("PSNR", "{:.2f} dB"),
    "psnr_enhanced": ("PSNR, lifted", "{:.2f} dB"),
    "ssim": ("SSIM", "{:.4f}"),
    "lpips": ("LPIPS", "{:.4f}"),
    "depth_mae": ("depth error", "{:.4f}"),
    "warp_error": ("warping error", "{:.4f}"),
    "corner_error": ("corner error", "{:.2f} pixels"),
    "image_psnr": ("PSNR, whole picture", "{:.2f} dB"),
    "train_seconds": ("training", "{:.0f} s"),
    "rays_per_second": ("rays per second", "{:,.0f}"),
    "peak_memory_mb": ("peak memory", "{:,.0f} MiB"),
}


def print_summary(console: Console, metrics: dict[str, Any], folder: Path) -> None:
    """Print the scores of a run and where it is."""
    title = f"{metrics['dataset']} · {metrics['backbone']} · ctm={metrics['ctm']} · seed {metrics['seed']}"
    table = Table(show_header=False)
    for key, (label, form) in ROWS.items():
        value = metrics.get(key)
        if value is not None:
            table.add_row(label, form.format(value))
    if metrics.get("converged") is False:
        table.add_row("not converged", "within 1 dB of one constant colour")
    console.print(title, soft_wrap=True, highlight=False)
    console.print(table)
    console.print(f"written to {folder}", soft_wrap=True)


def quieten() -> None:
    """Lightning's advice on data loaders and its list of devices are not for our users."""
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
