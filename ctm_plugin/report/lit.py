"""Lit views of dark captures: a table of runs with references in normal light, beside what others published on LOM."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence

from ctm_plugin.metrics.table import METRICS
from ctm_plugin.report.alike import check_alike, without_what_scenes_share
from ctm_plugin.report.gather import (
    Cell,
    Column,
    Gathered,
    all_settings,
    backgrounds_of,
    budget_of,
    by_row,
    cell_of,
    check_single,
    compare,
    set_ranks,
)
from ctm_plugin.report.paper import Row
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

    Raises:
        CTMError: runs differ in what no table varies, or one is there twice.
    """
    check_alike(runs)
    runs, by_scene = without_what_scenes_share(runs)
    rows = by_row(all_settings(runs), runs)
    for row, members in rows:
        check_single(row, members)
    nets = sorted({run.metrics["lpips_net"] for run in runs if run.metrics.get("lpips_net")})
    nets += [NET] if any(map(is_lom, runs)) and NET not in nets else []
    columns = [Column(METRICS[metric].label, metric) for metric in SCORES[:2]]
    columns += [Column(f"LPIPS ({net}), lit", "lpips_lit") for net in nets]
    columns += [Column("PSNR, dark", "psnr")]
    columns += [Column("the same, fitted to the left half", "psnr_fitted")] * has_appearances(runs)
    found = Gathered("Lit views", "", columns, [], [])
    scenes = sorted({run.scene for run in runs})
    for scene in scenes:
        _add_scene(found, nets, scene, [(row, [run for run in of_row if run.scene == scene]) for row, of_row in rows])
        if any(run.scene == scene and is_lom(run) for run in runs):
            _add_published(found, nets, scene)
    if len(scenes) > 1:
        everywhere = [(row, members) for row, members in rows if {run.scene for run in members} == set(scenes)]
        _add_scene(found, nets, f"mean of {len(scenes)} scenes", everywhere)
    if any(map(is_lom, runs)):
        _add_published(found, nets, "mean of LOM's five scenes")
    reference = next(row for row, _ in rows)
    for row, members in rows[1:]:
        label = f"{row.label} - {reference.label}"
        pairs = (compare(label, metric, members, rows[0][1]) for metric in SCORES)
        found.comparisons += [each for each in pairs if each]
    found.notes = [*_notes(runs), *by_scene]
    return found


def _add_scene(found: Gathered, nets: Sequence[str], name: str, rows: Sequence[tuple[Row, list[Run]]]) -> None:
    """A scene's rows, or those of the mean over scenes: settings, photographs, fitted colours."""
    rows = [(row, members) for row, members in rows if members]
    if not rows:
        return
    lines = [_cells(found.columns, nets, "", row, members) for row, members in rows]
    set_ranks(lines, found.columns)
    found.labels += [f"{name}: {row.label}" for row, _ in rows]
    found.cells += lines
    photographs = {
        run.scene: run for run in rows[0][1]
    }  # the same for all settings without an appearance, which come first
    found.labels.append(f"{name}: the dark photographs themselves, brightened")
    found.cells.append(_cells(found.columns, nets, "_photo", rows[0][0], list(photographs.values()), seeds=False))
    for row, members in rows:
        found.labels.append(f"{name}: {row.label}, colours fitted to the references (an oracle)")
        found.cells.append(_cells(found.columns, nets, "_fitted", row, members))


def _cells(
    columns: Sequence[Column], nets: Sequence[str], which: str, row: Row, runs: Sequence[Run], seeds: bool = True
) -> list[Cell]:
    """A line of the table: the metrics of :data:`SCORES` whose names end so; LPIPS in its network's column."""
    cells = []
    for column in columns:
        metric = column.metric + which if column.metric in SCORES else column.metric
        these = runs
        if column.metric == "lpips_lit":
            net = nets[columns.index(column) - len(SCORES) + 1]
            these = [run for run in runs if run.metrics.get("lpips_net") == net]
        if which and column.metric not in SCORES:
            these = []
        if seeds:
            cells.append(cell_of(row, these, Column(column.label, metric)))
            continue
        values = [value for run in these if (value := run.value(metric)) is not None]
        cells.append(Cell(mean=statistics.fmean(values) if values else None, scenes=1))
    return cells


def _add_published(found: Gathered, nets: Sequence[str], name: str) -> None:
    known: Mapping[str, tuple[float, ...]] = PUBLISHED[name]
    for method, (psnr, ssim, lpips) in known.items():
        of_nets = [Cell(paper=lpips) if net == NET else Cell() for net in nets]
        found.labels.append(f"{name}: {method}, as published")
        others = [Cell()] * (len(found.columns) - 2 - len(nets))
        found.cells.append([Cell(paper=psnr), Cell(paper=ssim), *of_nets, *others])


def _notes(runs: Sequence[Run]) -> list[str]:
    protocols = sorted({run.metrics["protocol"] for run in runs})
    published = [f"Published: {SOURCE}; its LPIPS is of {NET.upper()}."] if any(map(is_lom, runs)) else []
    return [
        "Lit: rendered dark, brightened by one factor that the training pictures alone decide, against pictures in "
        "normal light. Fitted: after one affine map of colours fitted to these very pictures, no method's score.",
        *published,
        *(f"Protocol: {protocol}." for protocol in protocols),
        budget_of(runs),
        *backgrounds_of(runs),
    ]
