"""What sets runs apart: names of their scenes and rows by the settings in which they differ."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from ctm_plugin.report.runs import BACKGROUNDS, BUDGET, EVERYWHERE, GEOMETRY, Run, Setting
from ctm_plugin.settings.check import is_number

MOST_KEYS = 6
"""More keys than that name a row only as far as they tell runs apart: two versions differ in dozens."""
CHOICES = (BUDGET, GEOMETRY)
"""Keys from which others follow, such as sizes: what follows is not named with them."""
BASE = {"color_space": "rgb", "loss": "mse", "appearance": "none"}
"""Values that are not said."""
TERMS = ("enc", "dec", "img", "rand", "latent")


def scenes_apart(runs: Sequence[Run]) -> list[Run]:
    """Give scenes of one name, of which runs were scored on different pictures, names of their own.

    By the data's settings that differ, such as ``lego (dataset.exposure=0.02)``; where none does, by the protocol or
    the pictures' fingerprint. Random backgrounds are in the fingerprint, and patches differ from seed to seed.
    """
    keys = {scene: _named(those, ("dataset",), ()) for scene, those in _grouped(runs, lambda run: run.scene).items()}
    protocols, prints = defaultdict(set), defaultdict(set)

    def data(run: Run) -> tuple:
        return run.scene, *(repr(value) for key, value in run.rest.items() if key.startswith("dataset"))

    for run in runs:
        protocols[run.scene, repr(run.rest["dataset"])].add(run.metrics["protocol"])
        prints[data(run)].add(None if run.aligned else run.metrics.get("data"))

    def apart(run: Run) -> Run:
        said = [f"{key}={_text(run, key)}" for key in keys[run.scene]]
        said += [run.metrics["protocol"]] if len(protocols[run.scene, repr(run.rest["dataset"])]) > 1 else []
        said += [f"data={run.metrics.get('data')}"] if len(prints[data(run)] - {None}) > 1 else []
        return replace(run, metrics=run.metrics | {"dataset": f"{run.scene} ({', '.join(said)})"}) if said else run

    return [apart(run) for run in runs]


def set_apart(runs: Sequence[Run]) -> list[Run]:
    """Give each run's setting the keys in which it differs from others of its backbone, or of its transform there."""
    keys: dict[tuple, list[str]] = {}
    for parts, of in _KINDS:
        for kind, those in _grouped(runs, of).items():
            keys[parts, kind] = _named(those, parts)

    def apart(run: Run) -> Run:
        named = sorted({key for parts, of in _KINDS for key in keys[parts, of(run)]})
        others = ((_typed(key), _text(run, key)) for key in named)
        # A weight of 0 is among the setting's own.
        kept = tuple(each for each in others if each[1] != "null" or not each[0].startswith("ctm.weights."))
        return replace(run, setting=run.setting._replace(others=kept))

    return [apart(run) for run in runs]


_KINDS = (
    (EVERYWHERE, lambda run: ()),
    (("backbone", "trainer"), lambda run: run.setting.backbone),
    (("ctm",), lambda run: (run.setting.backbone, run.setting.ctm)),
    (("appearance",), lambda run: (run.setting.backbone, run.setting.appearance)),
    # Random backgrounds are a transform's own: they set apart what would be one run.
    ((BACKGROUNDS,), lambda run: (run.setting, run.scene)),
)
"""Parts of a configuration, and of which runs they are compared."""


def _named(runs: Sequence[Run], parts: Sequence[str], choices: Sequence[str] = CHOICES) -> list[str]:
    """Keys of some parts that tell runs apart, without those that follow from choices."""
    found = {key for run in runs for part in parts for key in _differences(run.rest[part], runs[0].rest[part], part)}

    def classes(keys: Iterable[str]) -> int:
        return len({tuple(_text(run, key) for key in keys) for run in runs})

    own = [key for key in sorted(found) if key in EVERYWHERE or classes((*choices, key)) > classes(choices)]
    if len(own) <= MOST_KEYS:
        return own
    named: list[str] = []
    for key in own:
        named += [key] if classes((*choices, *named, key)) > classes((*choices, *named)) else []
    return named


def without_what_scenes_share(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Take what all runs on a scene share, such as ``backbone.coarse``, out of what sets rows apart; tell of it."""
    values: dict[tuple[str, str, str], set[str]] = defaultdict(set)
    for run in runs:
        for key, value in run.setting.others:
            values[key, run.setting.backbone, run.scene].add(value)
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


def keys_of(setting: Setting) -> dict[str, str | None]:
    """A setting as keys of the command line; ``None`` for a preset's own value."""
    found = {key: getattr(setting, key) for key in ("backbone", "ctm", "color_space", "loss", "appearance")}
    sizes = {"backbone.encoding": setting.encoding, "ctm.P": setting.P, "ctm.k": setting.k}
    found |= {key: str(value) for key, value in sizes.items() if value is not None}
    if setting.ctm != "off":
        found |= {f"ctm.weights.{term}": "0" if term in setting.without else None for term in TERMS}
    return found | dict(setting.others)


def _typed(key: str) -> str:
    """A key as people type it: the budget is the choice of a trainer."""
    return "trainer" if key == BUDGET else key


def names(settings: Iterable[Setting]) -> dict[Setting, str]:
    """Name settings by the keys in which they differ, such as ``ctm=quick ctm.P=2``, without what most have."""
    found = {setting: keys_of(setting) for setting in settings}
    counts, common = _counts(found.values()), most_have(found)

    def name(keys: dict[str, str | None]) -> str:
        unsaid = BASE | common
        said = [key for key, value in keys.items() if len(counts[key]) > 1 and value not in (None, unsaid.get(key))]
        own = [key for key in ("backbone", "ctm", *BASE) if keys[key] != BASE.get(key)]
        return " ".join(f"{key}={keys[key]}" for key in said or own)

    return {setting: name(keys) for setting, keys in found.items()}


def most_have(settings: Iterable[Setting]) -> dict[str, str]:
    """The values of more than half of the settings, of keys in which they differ: names leave them out."""
    found = [keys_of(setting) for setting in settings]
    tops = {key: (*counts.most_common(1)[0], len(counts)) for key, counts in _counts(found).items() if "." in key}
    return {key: value for key, (value, count, kinds) in tops.items() if value and kinds > 1 and 2 * count > len(found)}


def _counts(found: Iterable[dict[str, str | None]]) -> dict[str, Counter]:
    counts: dict[str, Counter] = defaultdict(Counter)
    for keys in found:
        for key, value in keys.items():
            counts[key][value] += 1
    return counts


def differing(one: Setting, other: Setting) -> set[str]:
    """Keys that two settings both have and have differently; a backbone's and a transform's own follow from it."""
    mine, theirs = keys_of(one), keys_of(other)
    found = {key for key in mine.keys() & theirs.keys() if mine[key] != theirs[key]}
    return {key for key in found if key.partition(".")[0] == key or key.partition(".")[0] not in found}


def _grouped(runs: Iterable[Run], of: Any) -> dict[Any, list[Run]]:
    found: dict[Any, list[Run]] = defaultdict(list)
    for run in runs:
        found[of(run)].append(run)
    return found


def _differences(a: Any, b: Any, key: str) -> Iterator[str]:
    """Keys at which two settings differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        for name in sorted({*a, *b}, key=str):
            # Weights of 0, which are left out, are what tables vary.
            if not (key == "ctm.weights" and (name in a) != (name in b)):
                yield from _differences(a.get(name), b.get(name), f"{key}.{name}")
    elif a != b:
        yield key


def _text(run: Run, key: str) -> str:
    """The value at a dotted key, whose first part may have a dot itself, as people type it: 1 and 1.0 are the same."""
    part = key if key in run.rest else next(name for name in run.rest if key.startswith(f"{name}."))
    value = run.rest[part]
    for name in key[len(part) + 1 :].split(".") if key != part else ():
        value = value.get(name) if isinstance(value, dict) else None
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    return str(int(value)) if is_number(value) and value == value // 1 else str(value)
