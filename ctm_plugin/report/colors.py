"""Colour spaces and transforms side by side, scene by scene: scores, and paired differences from two references."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from ctm_plugin.metrics.table import METRICS
from ctm_plugin.report.alike import agree, check_alike, without_what_scenes_share
from ctm_plugin.report.gather import (
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
from ctm_plugin.report.paper import SPACES, Row
from ctm_plugin.report.runs import Run, Setting

COMPARED = ("psnr", "psnr_enhanced", "ssim", "lpips", "depth_mae", "warp_error")
"""Metrics with paired differences; the step's time stands beside them."""

Rows = Sequence[tuple[Row, list[Run]]]


class Reference(NamedTuple):
    """Runs that others are compared with, and what they are called."""

    name: str
    runs: list[Run]


def has_colors(runs: Sequence[Run]) -> bool:
    """Whether runs are of ``experiment=colors``: some have a fixed space alone that is in no table of the paper."""
    return any(run.setting.ctm == "off" and run.setting.color_space not in SPACES for run in runs)


def colors_table(runs: Sequence[Run]) -> Gathered:
    """A row for each setting on each scene, and on the mean over a backbone's scenes.

    Below, differences of the same scene and seed from RGB, and from the closed form that scores best on that scene, for
    each metric its own: chosen by the very scores that are compared, which no single closed form can be above.

    Raises:
        CTMError: runs differ in what no table varies, or one is there twice.
    """
    check_alike(runs)
    runs, by_scene = without_what_scenes_share([_timed(run) for run in runs])
    rows = by_row(all_settings(runs), runs)
    for row, members in rows:
        check_single(row, members)
    shown = [metric for metric in (*COMPARED, "step_ms") if any(run.value(metric) is not None for run in runs)]
    found = Gathered("Colours", "", [Column(METRICS[metric].label, metric) for metric in shown], [], [])
    for scene in sorted({run.scene for run in runs}):
        there = [(row, [run for run in those if run.scene == scene]) for row, those in rows]
        there = [(row, those) for row, those in there if those]
        _add_block(found, scene, 1, there, there)
    for backbone in sorted({run.setting.backbone for run in runs}):
        own = [(row, members) for row, members in rows if members[0].setting.backbone == backbone]
        scenes = {run.scene for _, members in own for run in members}
        if len(scenes) > 1:
            everywhere = [(row, members) for row, members in own if {run.scene for run in members} == scenes]
            _add_block(found, f"mean of {len(scenes)} scenes", len(scenes), everywhere, own)
            lacking = [row.label for row, members in own if {run.scene for run in members} != scenes]
            if lacking:
                by_scene.append(f"Not on all {len(scenes)} scenes, so not in their mean: {', '.join(lacking)}.")
    found.notes = [*_notes(runs, rows), *by_scene]
    return found


def _timed(run: Run) -> Run:
    seconds, steps = run.value("train_seconds"), run.value("steps")
    return replace(run, metrics=run.metrics | {"step_ms": 1000 * seconds / steps if seconds and steps else None})


def _add_block(found: Gathered, name: str, scenes: int, rows: Rows, others: Rows) -> None:
    """Rows of one scene, or of the mean over some, and their differences from references among ``others``."""
    lines = [[replace(cell_of(row, those, each), expected=scenes) for each in found.columns] for row, those in rows]
    set_ranks(lines, found.columns)
    found.labels += [f"{name}: {row.label}" for row, _ in rows]
    found.cells += lines
    for row, members in rows:
        setting = members[0].setting
        metrics = [column.metric for column in found.columns if column.metric in COMPARED]
        plain = setting.ctm == "off" and setting.color_space == "rgb"
        plain_ones = [] if plain else rgb(others, setting)
        wanted = [(metric, reference) for reference in plain_ones for metric in metrics]
        if setting.ctm != "off" or scenes > 1:  # on a scene of its own the best closed form is one of these rows
            wanted += [(metric, best_closed_form(others, setting, metric)) for metric in metrics]
        for metric, reference in wanted:
            pairs = compare(f"{name}: {row.label} - {reference.name}", metric, members, reference.runs)
            found.comparisons += [pairs] if pairs else []


def rgb(rows: Rows, setting: Setting) -> list[Reference]:
    """The rows without a transform that a setting is compared with, by what sets them apart from one another."""
    fixed = _fixed(rows, setting, closed=False)

    def name(members: list[Run]) -> str:
        others = ", ".join(f"{key}={value}" for key, value in members[0].setting.others)
        return f"RGB ({others})" if others and len(fixed) > 1 else "RGB"

    return [Reference(name(members), members) for members in fixed]


def best_closed_form(rows: Rows, setting: Setting, metric: str) -> Reference:
    """Of each scene the runs of the fixed space that is best at a metric there; of those that most seeds have."""
    scored: dict[str, list[list[Run]]] = {}
    for members in _fixed(rows, setting, closed=True):
        for scene in {run.scene for run in members}:
            these = [run for run in members if run.scene == scene and run.value(metric) is not None]
            scored.setdefault(scene, []).extend([these] if these else [])
    sign = 1 if METRICS[metric].higher else -1

    def worth(runs: Sequence[Run]) -> tuple[int, float]:
        return len(runs), sign * statistics.fmean(run.value(metric) for run in runs)

    chosen = [run for of_scene in scored.values() if of_scene for run in max(of_scene, key=worth)]
    spaces = sorted({run.setting.color_space.partition(" ")[0] for run in chosen})
    return Reference(f"best closed form ({', '.join(spaces)})", chosen)


def _fixed(rows: Rows, setting: Setting, closed: bool) -> list[list[Run]]:
    """Rows without a learned transform that differ from a setting in colours alone; closed forms, or RGB."""
    shared = ("backbone", "loss", "encoding", "appearance")
    return [
        members
        for _, members in rows
        if (other := members[0].setting).ctm == "off"
        and (other.color_space != "rgb") == closed
        and all(getattr(other, name) == getattr(setting, name) for name in shared)
        and agree(setting, other)
    ]


def _notes(runs: Sequence[Run], rows: Rows) -> list[str]:
    alone = []
    for row, members in rows:
        plain = rgb(rows, members[0].setting)
        theirs = {(run.scene, run.seed) for reference in plain for run in reference.runs}
        alone += [
            f"{row.label} on {run.scene}, seed {run.seed}" for run in members if (run.scene, run.seed) not in theirs
        ]
    protocols = sorted({run.metrics["protocol"] for run in runs})
    return [
        "The best closed form is chosen scene by scene and metric by metric, by these very scores.",
        *(f"Protocol: {protocol}." for protocol in protocols),
        budget_of(runs),
        *backgrounds_of(runs),
        *(["Without a pair in RGB, left out of differences: " + "; ".join(alone) + "."] if alone else []),
    ]
