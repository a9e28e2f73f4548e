"""The HTML report: one file, with tables, pictures and curves in it."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from google.protobuf.message import DecodeError
from jinja2 import Environment, PackageLoader
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ctm_plugin import __version__
from ctm_plugin.errors import CheckpointError
from ctm_plugin.report import text
from ctm_plugin.report.gather import Gathered
from ctm_plugin.report.pairs import pairs, picture, pictures, where_they_differ
from ctm_plugin.report.runs import Found, Run

CURVES = ("psnr/test_view", "psnr/rgb")
"""The first of these that a run has is drawn."""
TITLES = {
    "render": "render", "lifted": "lifted", "latent": "latent", "depth": "depth", "warps": "warps",
    "patches": "patches", "fused": "fused picture",
}  # fmt: skip


def page(tables: Sequence[Gathered], found: Found) -> str:
    """HTML that needs nothing else; names from runs are escaped."""
    environment = Environment(loader=PackageLoader("ctm_plugin.report", "."), autoescape=True)
    marked = {1: "{} ●", 2: "{} ○"}
    return environment.get_template("page.html.jinja").render(
        tables=[
            {
                "table": table,
                "headings": text.headings(table),
                "lines": text.lines(table, marked),
                "against": text.against(table),
            }
            for table in tables
        ],
        paired=text.PAIRED,
        comparisons=[compared(off, on) for off, on in pairs(found.runs)],
        unfinished=found.unfinished,
        count=len(found.runs),
        version=__version__,
    )


def compared(off: Run, on: Run) -> dict:
    """A run without CTM beside one with it: sliders, the crop where they differ most, curves."""
    mine, theirs = pictures(off), pictures(on)
    both = {kind: (picture(off, kind), picture(on, kind)) for kind in mine if kind in theirs}
    shown = next((kind for kind in ("lifted", "fused", "render") if kind in both), None)
    crops = []
    if shown is not None and both[shown][0].shape == both[shown][1].shape:
        window = where_they_differ(*both[shown])
        crops = [embedded(np.kron(each[window], np.ones((4, 4, 1), np.uint8))) for each in both[shown]]
    setting = off.setting
    return {
        "title": " · ".join(filter(None, [off.scene, setting.backbone, setting.encoding, f"seed {off.seed}"])),
        "ctm": on.setting.ctm,
        "scores": (off.value("psnr"), on.value("psnr")),
        "sliders": [
            {"title": TITLES[kind], "off": embedded(first), "on": embedded(second), "width": max(256, first.shape[1])}
            for kind, (first, second) in both.items()
        ],
        "crops": crops,
        "curves": curves(off, on),
    }


def embedded(content: np.ndarray) -> str:
    """A picture, ``[H, W, 3]`` bytes, as a data URL."""
    return f"data:image/png;base64,{base64.b64encode(iio.imwrite('<bytes>', content, extension='.png')).decode()}"


def curves(off: Run, on: Run) -> str | None:
    """PSNR against steps of both runs, as a data URL; ``None`` where neither has a curve."""
    drawn = {label: curve for label, run in (("without CTM", off), ("with CTM", on)) if (curve := curve_of(run.folder))}
    if not drawn:
        return None
    figure = Figure(figsize=(5, 2.6), layout="constrained")
    axes = figure.add_subplot(xlabel="step", ylabel="PSNR, dB")
    for label, (steps, values) in drawn.items():
        axes.plot(steps, values, label=label)
    axes.legend()
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110)
    return f"data:image/png;base64,{base64.b64encode(out.getvalue()).decode()}"


def curve_of(run: Path) -> tuple[list[int], list[float]] | None:
    """Steps and PSNR that TensorBoard has of a run.

    Raises:
        CheckpointError: its files are damaged.
    """
    folder = run / "tensorboard"
    if not folder.is_dir():
        return None
    events = EventAccumulator(str(folder), size_guidance={"scalars": 500, "images": 1, "tensors": 1, "histograms": 1})
    try:
        events.Reload()
    except (DecodeError, ValueError, OverflowError, MemoryError) as error:  # lengths that a file claims are believed
        raise CheckpointError(folder, f"no readable curves ({type(error).__name__})", "TensorBoard's files") from error
    for tag in CURVES:
        points = events.Scalars(tag) if tag in events.Tags()["scalars"] else []
        if len(points) > 1:
            return [point.step for point in points], [point.value for point in points]
    return None
