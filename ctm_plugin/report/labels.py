"""Names of scenes and rows in a report, by the settings in which their runs differ."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from ctm_plugin.report.runs import Run, Setting, read_runs, weights
from ctm_plugin.runs.rundir import METRICS

MAX_KEYS = 6
"""Most keys that name a row without selection; of more, as between two versions, only distinguishing ones do."""
BACKGROUNDS, BUDGET, GEOMETRY = "dataset.background_level", "trainer.budget", "dataset.geometry"
CAUSE_KEYS = (BUDGET, GEOMETRY)
"""Keys from which others, such as sizes, follow; keys that follow do not name a row."""
SHARED_KEYS = (*CAUSE_KEYS, "dataset.near", "dataset.far", "loss.weight", "metrics.lpips_net")
"""Keys that runs of all backbones may share; of ``dataset``'s keys only those that change no test picture."""
UNNAMED_VALUES = {"color_space": "rgb", "loss": None, "appearance": "none"}
"""Values by key that do not name a row."""
PAPER_KEYS = ("backbone", "ctm", *UNNAMED_VALUES, "backbone.encoding", "ctm.P", "ctm.k")
"""Keys that the paper's tables vary, besides weights of 0."""


class Found(NamedTuple):
    """The runs found below some folders, and those left out."""

    runs: list[Run]
    left_out: list[str]
    """Folders of runs left out, each with the reason: no scores yet, a sweep's error, damaged, a duplicate."""
    shared: list[str]
    """Settings that are alike in all runs of a backbone on one scene, but differ between scenes."""


def find_runs(folders: Sequence[Path]) -> Found:
    """Find all runs in folders and below them that can be reported on, labelled, and what is left out.

    Raises:
        CheckpointError: a folder is missing or holds no run.
    """
    whole, left_out = read_runs(folders)
    runs, shared = set_apart(scenes_apart(whole))
    by_time = sorted(runs, key=lambda run: (run.folder / METRICS).stat().st_mtime_ns)
    newest = {(run.scene, run.seed, run.key): run for run in by_time}
    labels = names(run.setting for run in runs)
    kept = []
    for run in runs:
        if (other := newest[run.scene, run.seed, run.key]) is run:
            kept.append(replace(run, label=labels[run.key]))
        else:
            left_out.append(f"{run.folder}: the same run as {other.folder}, which is newer and is counted")
    return Found(kept, left_out, shared)


def scenes_apart(runs: Sequence[Run]) -> list[Run]:
    """Rename scenes of one name whose runs were scored on different pictures, so that each has its own name.

    Names have the data's settings that differ, ``lego (dataset.exposure=0.02)``; where none does, the protocol or
    the pictures' fingerprint. Random backgrounds are in the fingerprint, and patches differ from seed to seed.
    """
    note: dict[int, list[str]] = {id(run): [] for run in runs}

    def tell_apart(runs: Sequence[Run], keys: Sequence[str], seen: Callable[[Run], str | None], before: str) -> None:
        for alike in grouped(runs, lambda run: tuple(map(run.rest.get, keys))).values():
            if len({seen(run) for run in alike} - {None}) > 1:
                for run in alike:
                    note[id(run)].append(f"{before}{seen(run)}")

    for members in grouped(runs, lambda run: run.scene).values():
        data = [key for run in members for key in run.rest if key.startswith("dataset.")]
        keys = _telling(members, lambda key: key.startswith("dataset.") and key not in (*SHARED_KEYS, BACKGROUNDS))
        for run in members:
            note[id(run)] += [f"{key}={run.rest.get(key, 'null')}" for key in keys]
        tell_apart(members, keys, lambda run: run.metrics["protocol"], "")
        tell_apart(members, data, lambda run: None if "warp_error" in run.metrics else run.metrics.get("data"), "data=")
    more = {of: f" ({', '.join(words)})" if words else "" for of, words in note.items()}
    return [replace(run, metrics=run.metrics | {"dataset": run.scene + more[id(run)]}) for run in runs]


def set_apart(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Add to each run's setting the keys in which runs of its backbone, or of its transform with it, differ on a scene.

    A key that differs only between scenes, such as ``backbone.coarse``, becomes a note: rows are pooled over scenes.
    """
    more: dict[int, Setting] = {id(run): {} for run in runs}
    notes = set()
    for of, concerns in COMPARISONS:
        for members in grouped(runs, lambda run, of=of: (run.setting["backbone"], of(run))).values():
            scenes = grouped(members, lambda run: run.scene)
            within = {key for of_scene in scenes.values() for key in _telling(of_scene, concerns, CAUSE_KEYS)}
            for key in within.union(_telling(members, concerns, CAUSE_KEYS)):
                for run in members:
                    name, value = "trainer" if key == BUDGET else key, run.rest.get(key, "null")
                    if value == "null" and weights({key: value}):  # of 0: it is among the setting's own
                        continue
                    if key in within:
                        more[id(run)][name] = value
                    else:
                        notes.add((name, run.setting["backbone"], run.scene, value))
    runs = [replace(run, setting=run.setting | dict(sorted(more[id(run)].items()))) for run in runs]
    return runs, [f"All of {backbone} on {scene}: {key}={value}." for key, backbone, scene, value in sorted(notes)]


def _of(*sections: str) -> Callable[[str], bool]:
    return lambda key: key.partition(".")[0] in sections and key not in SHARED_KEYS


COMPARISONS: tuple[tuple[Callable[[Run], Any], Callable[[str], bool]], ...] = (
    (lambda run: (), lambda key: key in SHARED_KEYS or _of("backbone", "trainer")(key)),
    (lambda run: run.setting["ctm"], _of("ctm")),
    (lambda run: run.setting["appearance"], _of("appearance")),
    # Random backgrounds are a transform's own: they set apart what would be one run.
    (lambda run: (run.key, run.scene), lambda key: key == BACKGROUNDS),
)
"""Pairs of functions: which group a run is compared in, and which keys are compared there."""


def _telling(runs: Sequence[Run], concerns: Callable[[str], bool], choices: Sequence[str] = ()) -> list[str]:
    """Keys that tell runs apart, without those that follow from choices."""

    def kinds(*keys: str) -> int:
        return len({tuple(run.rest.get(key, "null") for key in keys) for run in runs})

    def differs(key: str) -> bool:
        # Weights of 0, which are left out, are what tables vary.
        return len({run.rest.get(key) for run in runs} - ({None} if weights({key: None}) else set())) > 1

    keys = sorted({key for run in runs for key in run.rest if concerns(key)})
    own = [key for key in keys if differs(key) and (key in SHARED_KEYS or kinds(*choices, key) > kinds(*choices))]
    if len(own) <= MAX_KEYS:
        return own
    named: list[str] = []
    for key in own:
        named += [key] if kinds(*choices, *named, key) > kinds(*choices, *named) else []
    return named


def others(setting: Setting) -> Setting:
    """The part of a setting besides the keys that the paper's tables vary."""
    zeros = {key for key, value in weights(setting).items() if value in (None, "0")}
    return {key: value for key, value in setting.items() if key not in (*PAPER_KEYS, *zeros)}


def names(settings: Iterable[Setting]) -> dict[tuple, str]:
    """Name settings by the keys in which they differ, such as ``ctm=quick ctm.P=2``, without the most common values."""
    unique = list({tuple(setting.items()): setting for setting in settings}.values())
    counts, unsaid = _counts(unique), UNNAMED_VALUES | most_have(unique)

    def name(keys: Setting) -> str:
        parts = [key for key, value in keys.items() if len(counts[key]) > 1 and value not in (None, unsaid.get(key))]
        own = [key for key in ("backbone", "ctm", *UNNAMED_VALUES) if keys[key] != UNNAMED_VALUES.get(key)]
        return " ".join(f"{key}={keys[key]}" for key in parts or own)

    return {tuple(setting.items()): name(setting) for setting in unique}


def most_have(settings: Sequence[Setting]) -> dict[str, str]:
    """Find the values of more than half of the settings, of keys in which they differ: names leave them out."""
    counted = {key: counts for key, counts in _counts(settings).items() if "." in key and len(counts) > 1}
    tops = {key: counts.most_common(1)[0] for key, counts in counted.items() if None not in counts}
    return {key: value for key, (value, count) in tops.items() if 2 * count > len(settings)}


def _counts(settings: Iterable[Setting]) -> dict[str, Counter]:
    counts: dict[str, Counter] = defaultdict(Counter)
    for setting in settings:
        for key, value in setting.items():
            counts[key][value] += 1
    return counts


def differing(one: Setting, other: Setting) -> set[str]:
    """Find keys whose values differ between two settings; keys below a choice that differs itself do not count."""
    keys = {key for key in one.keys() & other.keys() if one[key] != other[key]}
    return {key for key in keys if key.partition(".")[0] == key or key.partition(".")[0] not in keys}


def grouped(runs: Iterable[Run], of: Callable[[Run], Hashable]) -> dict[Any, list[Run]]:
    """Group runs by the value of a function of them."""
    groups: dict[Any, list[Run]] = defaultdict(list)
    for run in runs:
        groups[of(run)].append(run)
    return groups
