"""Lit views of dark captures: a table of runs with references in normal light, with what others published on LOM."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ctm_plugin.metrics.table import METRICS
from ctm_plugin.report.gather import (
    Cell,
    Column,
    Gathered,
    Rows,
    by_scene,
    cell_of,
    configurations,
    notes_of,
    set_ranks,
)
from ctm_plugin.report.runs import Run, has_appearances

SCORES = ("psnr_lit", "ssim_lit", "lpips_lit")
SOURCE = "Cui et al., Aleth-NeRF, AAAI 2024, at 500x375"
NET = "vgg"
"""Of the published LPIPS; another network's is another measure, and has a column of its own."""
PUBLISHED = {
    "buu": {"Aleth-NeRF": (20.22, 0.859, 0.315)},
    "chair": {"Aleth-NeRF": (20.93, 0.818, 0.468)},
    "bike": {"Aleth-NeRF": (20.46, 0.727, 0.499)},
    "mean of LOM's five scenes": {
        "NeRF": (6.84, 0.150, 0.582), "MBLLEN + NeRF": (18.65, 0.728, 0.507), "Aleth-NeRF": (19.87, 0.754, 0.417),
    },
}  # fmt: skip
"""PSNR, SSIM and LPIPS of lit views by scene and method, as published."""


def has_lit(run: Run) -> bool:
    """Whether a run was scored against pictures in normal light."""
    return run.value("psnr_lit") is not None


def is_lom(run: Run) -> bool:
    """Whether a run follows LOM's protocol on one of its scenes whose published values are known."""
    dataset = run.config["dataset"]
    return run.scene in PUBLISHED and (dataset.get("dark"), dataset.get("lit")) == ("low", "high")


def lit_table(runs: Sequence[Run]) -> Gathered:
    """Scores of lit views, scene by scene and on the mean.

    Each scene has a row a setting; what brightening the dark photographs of the test views gives, a yardstick; each
    setting with the colour map that was fitted to the references, an oracle; and of LOM's scenes the published values.
    """
    of_lom = {run.scene for run in runs if is_lom(run)}
    nets = {run.metrics["lpips_net"] for run in runs if run.metrics.get("lpips_net")} | ({NET} if of_lom else set())
    columns = [Column(METRICS[metric].label, metric) for metric in SCORES[:2]]
    columns += [Column(f"LPIPS ({net}), lit", "lpips_lit", net=net) for net in sorted(nets)]
    columns += [Column("PSNR, dark", "psnr")]
    columns += [Column("the same, fitted to the left half", "psnr_fitted")] * has_appearances(runs)
    found = Gathered("Lit views", "", columns, [], [], notes=_notes(runs))
    for name, rows in by_scene(configurations(runs)):
        _add_block(found, name, rows)
        if name in of_lom:
            _add_published(found, name)
    if of_lom:
        _add_published(found, "mean of LOM's five scenes")
    return found


def _add_block(found: Gathered, name: str, rows: Rows) -> None:
    """A scene's rows, or those of the mean over scenes: settings, photographs, fitted colours."""
    lines = [[cell_of(members, column) for column in found.columns] for _, members in rows]
    set_ranks(lines, found.columns)
    found.labels += [f"{name}: {label}" for label, _ in rows]
    found.cells += lines
    photographs = {run.scene: run for run in rows[0][1]}  # the same for all without an appearance, which come first
    found.labels.append(f"{name}: the dark photographs themselves, brightened")
    found.cells.append([cell_of(list(photographs.values()), column) for column in _of(found.columns, "_photo")])
    for label, members in rows:
        found.labels.append(f"{name}: {label}, colours fitted to the references (an oracle)")
        found.cells.append([cell_of(members, column) for column in _of(found.columns, "_fitted")])


def _of(columns: Sequence[Column], which: str) -> list[Column]:
    """The columns of the same scores of other pictures, such as ``psnr_lit_photo``; of the rest nothing is scored."""
    return [replace(each, metric=each.metric + which if each.metric in SCORES else "") for each in columns]


def _add_published(found: Gathered, name: str) -> None:
    for method, values in PUBLISHED[name].items():
        known = dict(zip(SCORES, values, strict=True))
        found.labels.append(f"{name}: {method}, as published")
        cells = (known.get(each.metric) if each.net in (None, NET) else None for each in found.columns)
        found.cells.append([Cell(paper=value) for value in cells])


def _notes(runs: Sequence[Run]) -> list[str]:
    published = [f"Published: {SOURCE}; its LPIPS is of {NET.upper()}."] if any(map(is_lom, runs)) else []
    return [
        "Lit: rendered dark, brightened by one factor that is found from the training pictures, against pictures in "
        "normal light. Fitted: after one affine map of colours fitted to these very pictures, no method's score.",
        *published,
        *notes_of(runs),
    ]
