"""What sets runs apart: names of their scenes and rows by the settings in which they differ."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from ctm_plugin.report.runs import Run, Setting, read_runs, weights
from ctm_plugin.runs.rundir import METRICS

MAX_KEYS = 6
"""Most keys that all name a row; of more, only those that tell runs apart do: two versions differ in dozens."""
BACKGROUNDS, BUDGET, GEOMETRY = "dataset.background_level", "trainer.budget", "dataset.geometry"
CAUSE_KEYS = (BUDGET, GEOMETRY)
"""Keys that others, such as sizes, follow from: what follows does not name a row."""
SHARED_KEYS = (*CAUSE_KEYS, "dataset.near", "dataset.far", "loss.weight", "metrics.lpips_net")
"""Keys that runs of all backbones may share; of the data's keys, those that change no test picture."""
UNNAMED_VALUES = {"color_space": "rgb", "loss": None, "appearance": "none"}
"""Values by key that do not name a row."""
PAPER_KEYS = ("backbone", "ctm", *UNNAMED_VALUES, "backbone.encoding", "ctm.P", "ctm.k")
"""Keys that the paper's tables vary, besides weights of 0."""


class Found(NamedTuple):
    """Runs below some folders."""

    runs: list[Run]
    left_out: list[str]
    """Folders of other runs, each with the reason: no scores yet, the error that a sweep saw, damaged, doubled."""
    shared: list[str]
    """Settings that all runs of a backbone on a scene share, and those on other scenes do not."""


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
    """Give scenes of one name, of which runs were scored on different pictures, names of their own.

    By the data's settings that differ, such as ``lego (dataset.exposure=0.02)``; where none does, by the protocol or
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
    """Give each run's setting the keys in which runs of its backbone, or of its transform there, differ on a scene.

    A key that only differs between scenes, such as ``backbone.coarse``, is in a note: rows are pooled over scenes.
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
    """Keys in which runs of a report differ besides those that the paper's tables vary."""
    zeros = {key for key, value in weights(setting).items() if value in (None, "0")}
    return {key: value for key, value in setting.items() if key not in (*PAPER_KEYS, *zeros)}


def names(settings: Iterable[Setting]) -> dict[tuple, str]:
    """Name settings by the keys in which they differ, such as ``ctm=quick ctm.P=2``, without what most have."""
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
    """Find keys that two settings both have and have differently; a backbone's and a transform's own follow from it."""
    keys = {key for key in one.keys() & other.keys() if one[key] != other[key]}
    return {key for key in keys if key.partition(".")[0] == key or key.partition(".")[0] not in keys}


def grouped(runs: Iterable[Run], of: Callable[[Run], Hashable]) -> dict[Any, list[Run]]:
    """Sort runs by something that they share."""
    groups: dict[Any, list[Run]] = defaultdict(list)
    for run in runs:
        groups[of(run)].append(run)
    return groups
