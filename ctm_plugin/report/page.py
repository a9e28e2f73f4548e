"""The HTML report: one file, with tables and pictures in it."""

from __future__ import annotations

import base64
import itertools
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from urllib.parse import quote

import imageio.v3 as iio
import numpy as np
from jinja2 import Environment, PackageLoader

from ctm_plugin import __version__
from ctm_plugin.report.cells import Table
from ctm_plugin.report.labels import Found
from ctm_plugin.report.pairs import pairs, picture, pictures, where_they_differ
from ctm_plugin.report.runs import Run
from ctm_plugin.report.tables import by_scene, configurations
from ctm_plugin.report.text import written
from ctm_plugin.runs.rundir import PAGE

PICTURE_KINDS = ("lit", "dark", "latent", "depth", "warps", "patches", "fused")


def page(tables: Sequence[Table], group: Found, home: Path) -> str:
    """The report as HTML that needs no other file, with links from the folder ``home`` to the runs' pages."""
    environment = Environment(loader=PackageLoader("ctm_plugin.report", "."), autoescape=True)
    return environment.get_template("page.html.jinja").render(
        tables=[written(table, "html") for table in tables],
        scenes=[scene_entry(scene, runs) for scene, runs in first_seeds(group.runs).items()],
        left_out=group.left_out,
        pages={str(run.folder): link(run.folder / PAGE, home) for run in group.runs if (run.folder / PAGE).is_file()},
        count=len(group.runs),
        version=__version__,
    )


def link(path: Path, home: Path) -> str:
    """A file's relative URL from the folder ``home``."""
    return quote(os.path.relpath(path, home))


def first_seeds(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """The runs of each scene, one a setting, of the first seed; those without CTM come first."""
    rows = by_scene(configurations(runs))
    return {scene: [min(members, key=lambda run: run.seed) for _, members in own] for scene, own in rows.items()}


def scene_entry(scene: str, runs: Sequence[Run]) -> dict:
    """The template's variables of a scene: its title, the runs' names, and the pictures of the sliders by kind.

    Runs are numbered from 1, the photograph is 0. A slider's ``windows`` are the parts where two runs differ most.

    At first the sliders show plain RGB and ``ctm=auto``, or another transform where that is missing.
    """
    layers = {kind: of_kind for kind in PICTURE_KINDS if (of_kind := layers_of(kind, runs))}
    numbers = sorted({number for of_kind in layers.values() for number in of_kind})
    both = pairs([run for run in runs if run.setting["ctm"] in ("off", "auto")]) or pairs(runs)
    first, second = [1 + runs.index(run) for run in both[0]] if both else (numbers * 2)[:2] or (0, 0)
    target = layers.get("lit", {}).get(0)
    scored = [run.label + ("" if (psnr := run.value("psnr")) is None else f" {psnr:.2f} dB") for run in runs]
    cropped = next((kind for kind in ("lit", "fused") if kind in layers), None)
    return {
        "title": f"{scene} · seed {runs[0].seed}",
        "names": {number: ["photograph", *scored][number] for number in numbers},
        "sides": (first, second),
        "photograph": None if target is None else embedded(target),
        "sliders": [
            {
                "title": "fused picture" if kind == "fused" else kind,
                "layers": {number: embedded(picture) for number, picture in of_kind.items()},
                "sides": [number for number in (first, second) if number in of_kind] or list(of_kind),
                "width": max(256, *(picture.shape[1] for picture in of_kind.values())),
                "windows": windows_of(of_kind) if kind == cropped else {},
            }
            for kind, of_kind in layers.items()
        ],
    }


def layers_of(kind: str, runs: Sequence[Run]) -> dict[int, np.ndarray]:
    """Pictures ``[H, W, 3]`` of a kind by number: 0 is the photograph, with lit ones, then come the runs'."""
    photographed = [run for run in runs if kind == "lit" and "photo" in pictures(run)]
    layers = {0: picture(photographed[0], "photo")} if photographed else {}
    return layers | {n: picture(run, kind) for n, run in enumerate(runs, 1) if kind in pictures(run)}


def windows_of(pictures: Mapping[int, np.ndarray]) -> dict[str, list[int]]:
    """Where any two pictures ``[H, W, 3]`` of one size differ most: left, top, width, height by both numbers."""
    windows = {}
    for (one, first), (other, second) in itertools.combinations(pictures.items(), 2):
        if first.shape == second.shape:
            rows, columns = where_they_differ(first, second)
            size = columns.stop - columns.start, rows.stop - rows.start
            windows[f"{one} {other}"] = [columns.start, rows.start, *size]
    return windows


def embedded(content: np.ndarray) -> str:
    """A picture, ``[H, W, 3]`` bytes, as a data URL."""
    png = iio.imwrite("<bytes>", content, extension=".png")
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"
