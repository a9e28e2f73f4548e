"""Which runs may stand in one table, and what sets their rows and scenes apart."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from ctm_plugin.errors import CTMError
from ctm_plugin.report.runs import BACKGROUNDS, Run, Setting
from ctm_plugin.settings.check import is_number

MOST_KEYS = 6
"""In how many keys runs may differ that have rows of their own: more would be another budget, and no name of a row."""


def set_apart(runs: Sequence[Run]) -> list[Run]:
    """Give each run's setting the keys in which it differs from others of its backbone, or of its transform there."""
    first: dict[tuple, Run] = {}
    keys: dict[tuple, set[str]] = {}
    for run in runs:
        for group, parts in _groups(run):
            other = first.setdefault(group, run)
            found = (_differences(run.rest[part], other.rest[part], part) for part in parts)
            keys.setdefault(group, set()).update(key for each in found for key, *_ in each)

    def apart(run: Run) -> Run:
        named = sorted(key for group, _ in _groups(run) for key in keys[group] if len(keys[group]) <= MOST_KEYS)
        others = tuple((key, _text(_at(run.rest, key))) for key in named)
        return replace(run, setting=run.setting._replace(others=others))

    return [apart(run) for run in runs]


def scenes_apart(runs: Sequence[Run]) -> list[Run]:
    """Add to scenes' names the data's settings in which runs on scenes of one name differ, such as exposure."""
    first: dict[str, Run] = {}
    keys: dict[str, set[str]] = {}
    for run in runs:
        other = first.setdefault(run.scene, run)
        differences = _differences(run.rest["dataset"], other.rest["dataset"], "dataset")
        keys.setdefault(run.scene, set()).update(key for key, *_ in differences)

    def apart(run: Run) -> Run:
        said = ", ".join(f"{key}={_text(_at(run.rest, key))}" for key in sorted(keys[run.scene]))
        return replace(run, metrics=run.metrics | {"dataset": f"{run.scene} ({said})"}) if said else run

    return [apart(run) for run in runs]


def without_what_scenes_share(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Take what all runs on a scene share, such as ``backbone.coarse``, out of what sets rows apart; tell of it."""
    values: dict[tuple[str, str, str], set[str]] = {}
    for run in runs:
        for key, value in run.setting.others:
            values.setdefault((key, run.setting.backbone, run.scene), set()).add(value)
    apart = {key for (key, *_), of_scene in values.items() if len(of_scene) > 1}
    told = [
        f"All of {backbone} on {scene}: {key}={next(iter(of_scene))}."
        for (key, backbone, scene), of_scene in sorted(values.items())
        if key not in apart
    ]

    def cut(run: Run) -> Run:
        others = tuple((key, value) for key, value in run.setting.others if key in apart)
        return replace(run, setting=run.setting._replace(others=others))

    return [cut(run) for run in runs], told


def same_text(settings: dict[str, Any]) -> str:
    """One text for equal settings, whatever their order."""
    return json.dumps(settings, sort_keys=True, default=str)


def agree(one: Setting, other: Setting) -> bool:
    """Tell whether two settings have the same values of what sets apart runs of both kinds."""
    values = dict(other.others)
    return all(values.get(key, value) == value for key, value in one.others)


def check_alike(runs: Sequence[Run]) -> None:
    """Refuse runs whose scores mean different things.

    Runs on one scene must share their protocol, the data set's settings and (scenes with views, before backgrounds of
    one level, which is in it) its fingerprint, runs of one backbone (on scenes of one geometry) its settings and
    budget, runs of one preset CTM's; LPIPS must be of one network.

    Raises:
        CTMError: two runs differ; both are named.
    """
    scenes: dict[str, Run] = {}
    kinds: dict[tuple, Run] = {}
    for run in runs:
        for key in ("lpips_net", "data"):
            value = run.metrics.get(key)
            # Patches differ from seed to seed.
            if value is not None and not (key == "data" and run.aligned):
                own = (run.scene, run.level) if key == "data" else ()
                other = kinds.setdefault((key, *own), run)
                if value != other.metrics[key]:
                    raise _mixed(run, other, f"{key} {value!r}", f"{other.metrics[key]!r}")
        other = scenes.setdefault(run.scene, run)
        if run.metrics["protocol"] != other.metrics["protocol"]:
            raise _mixed(run, other, f"protocol {run.metrics['protocol']!r}", f"{other.metrics['protocol']!r}")
        _compare(run, other, ("dataset",))
        for group, parts in _groups(run):
            _compare(run, kinds.setdefault(group, run), parts)


def _groups(run: Run) -> list[tuple[tuple, tuple[str, ...]]]:
    """Which runs must share which parts of a configuration: of a backbone, of a transform or appearance there.

    Random backgrounds are a transform's own: they set apart what would be one run.
    """
    kind = run.setting.backbone, run.rest["backbone"].get("geometry")
    apart = {"ctm": run.setting.ctm, "appearance": run.setting.appearance}
    return [
        (kind, ("backbone", "loss.weight", "trainer")),
        *(((*kind, *each), each[:1]) for each in apart.items()),
        ((*kind, run.setting, run.scene, same_text(run.rest["dataset"])), (BACKGROUNDS,)),
    ]


def _compare(run: Run, other: Run, parts: Sequence[str]) -> None:
    rows = {key for key, _ in run.setting.others}  # told apart by rows
    for part in parts:
        for key, mine, theirs in _differences(run.rest[part], other.rest[part], part):
            if key not in rows:
                raise _mixed(run, other, f"{key}={mine}", str(theirs))


def _differences(a: Any, b: Any, key: str) -> Iterator[tuple[str, Any, Any]]:
    """Keys at which two settings differ, with both values; weights of 0 are what tables vary."""
    if isinstance(a, dict) and isinstance(b, dict):
        for name in sorted({*a, *b}):
            if not (key == "ctm.weights" and (name in a) != (name in b)):
                yield from _differences(a.get(name), b.get(name), f"{key}.{name}")
    elif a != b:
        yield key, a, b


def _mixed(run: Run, other: Run, mine: str, theirs: str) -> CTMError:
    return CTMError(
        f"{run.folder}: found {mine}, expected {theirs} as in {other.folder}: runs of different protocols do not share "
        "a table; report on them apart"
    )


def _text(value: Any) -> str:
    """A value as people write it: 1 and 1.0 are the same number."""
    return str(int(value)) if is_number(value) and value == value // 1 else str(value)


def _at(rest: dict[str, Any], key: str) -> Any:
    """The value at a dotted key as :func:`_differences` has it, whose first part may have a dot itself."""
    part = key if key in rest else next(name for name in rest if key.startswith(f"{name}."))
    value = rest[part]
    for name in key[len(part) + 1 :].split(".") if key != part else ():
        value = value.get(name) if isinstance(value, dict) else None
    return value
