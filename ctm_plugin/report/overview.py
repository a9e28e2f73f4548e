"""The first table: all runs, a row for each configuration on each scene, and paired differences for each key."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterator, Sequence

from ctm_plugin.metrics.table import METRICS, told_at
from ctm_plugin.report.apart import BASE, differing, keys_of, most_have
from ctm_plugin.report.gather import (
    Column,
    Gathered,
    Rows,
    by_scene,
    cell_of,
    columns_of,
    compare,
    configurations,
    notes_of,
    score,
    set_ranks,
)
from ctm_plugin.report.paper import SPACES
from ctm_plugin.report.runs import Run, Setting

FIRST = BASE | {"ctm": "off"}
"""Values that others are compared with, where there are such runs."""


def overview(runs: Sequence[Run], shared: Sequence[str] = ()) -> Gathered:
    """A row for each setting on each scene, and on the mean over a backbone's scenes.

    Below, differences of the same scene and seed between settings that differ in one key. Where closed forms were
    swept, also from the one that scores best on that scene, for each metric its own: chosen by the very scores that are
    compared, which no single closed form can be above.

    Args:
        runs: of any settings.
        shared: what was found to be no difference between rows, see :class:`~ctm_plugin.report.find.Found`.
    """
    rows = configurations(runs)
    columns = columns_of((name for name in told_at("report") if any(run.value(name) is not None for run in runs)), runs)
    found = Gathered("All runs", "", columns, [], [], notes=[*notes_of(runs), *shared])
    if common := most_have(members[0].setting for _, members in rows):
        found.notes.append(f"In all rows without other values: {' '.join(f'{k}={v}' for k, v in common.items())}.")
    blocks = by_scene(rows)
    for name, own in blocks:
        lines = [[cell_of(members, column) for column in columns] for _, members in own]
        set_ranks(lines, columns)
        before = f"{name}: " if len(blocks) > 1 else ""
        found.labels += [before + label for label, _ in own]
        found.cells += lines
        for label, members in own:
            setting = members[0].setting
            # On a scene of its own the best closed form is one of these rows.
            best = has_colors(runs) and (len({run.scene for run in members}) > 1 or setting.ctm != "off")
            for column in (each for each in columns if METRICS[each.metric].of):
                references = [*references_of(own, setting), *([best_closed_form(own, setting, column)] if best else [])]
                for other, those in references:
                    found.comparisons += compare(f"{before}{label} - {other}", [column], members, those)
    if len(blocks) == 1:
        found.title += f": {blocks[0][0]}"
    return found


def has_colors(runs: Sequence[Run]) -> bool:
    """Whether runs are of ``experiment=colors``: some have only a fixed space that is in no table of the paper."""
    return any(run.setting.ctm == "off" and run.setting.color_space not in SPACES for run in runs)


def references_of(rows: Rows, setting: Setting) -> Iterator[tuple[str, list[Run]]]:
    """The rows that a setting is compared with: those that differ in one key and have there its reference value.

    Without CTM, RGB and the like; of other keys the value that most rows have, of several the first.
    """
    settings = [members[0].setting for _, members in rows]
    apart = [differing(setting, other) for other in settings]
    for key in sorted(keys_of(setting)):
        values = [keys_of(other).get(key) for other in settings]
        counts = Counter(values)
        there = [value for value, keys in zip(values, apart, strict=True) if keys == {key}] + [keys_of(setting)[key]]
        best = min(there, key=lambda value: (value != FIRST.get(key), -counts[value], values.index(value)))
        if best != keys_of(setting)[key]:
            for (label, members), keys, value in zip(rows, apart, values, strict=True):
                if keys == {key} and value == best:
                    yield label, members


def best_closed_form(rows: Rows, setting: Setting, column: Column) -> tuple[str, list[Run]]:
    """Of each scene the runs of the fixed space that is best in a column there; of those that most seeds have."""
    scored: dict[str, list[list[Run]]] = {}
    for _, members in rows:
        other = members[0].setting
        if other.ctm == "off" and other.color_space != "rgb" and differing(setting, other) <= {"ctm", "color_space"}:
            for scene in {run.scene for run in members}:
                these = [run for run in members if run.scene == scene and score(run, column) is not None]
                scored.setdefault(scene, []).extend([these] if these else [])
    sign = 1 if METRICS[column.metric].higher else -1

    def worth(runs: Sequence[Run]) -> tuple[int, float]:
        return len(runs), sign * statistics.fmean(score(run, column) for run in runs)

    chosen = [run for of_scene in scored.values() if of_scene for run in max(of_scene, key=worth)]
    spaces = sorted({run.setting.color_space.partition(" ")[0] for run in chosen})
    return f"best closed form ({', '.join(spaces)})", chosen
