"""Run directories, read for a report."""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from ctm_plugin.errors import CheckpointError, CTMError, printable
from ctm_plugin.runs.safe_read import check_folder, read_json, read_yaml
from ctm_plugin.settings.check import is_number

CONFIG, METRICS, ERROR = "config.yaml", "metrics.json", "error.txt"
MOST_KEYS = 6
"""In how many keys runs may differ that have rows of their own: more would be another budget, and no name of a row."""
BACKGROUNDS = "dataset.background_level"
"""Of the training alone, as test views are seen before black: a transform may have its own."""
LARGEST = 1e9
"""What no score reaches."""
TOLD = 10_000
"""Characters of a failed run's error that are told."""


class Setting(NamedTuple):
    """What the paper's tables vary; what is not said is the paper's own choice."""

    backbone: str
    ctm: str
    """The preset; ``off`` without CTM."""
    color_space: str = "rgb"
    loss: str = "mse"
    without: frozenset[str] = frozenset()
    """CTM's terms of weight 0 that its preset weighs."""
    P: int | None = None
    k: int | None = None
    encoding: str | None = None
    appearance: str = "none"
    others: tuple[tuple[str, str], ...] = ()
    """Keys and values in which runs of one report differ besides, see :func:`set_apart`."""


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        folder: where it is.
        config, metrics: what its files say.
        setting: what a table may vary.
        rest: the other settings that its scores depend on, plain containers.
        light: how its lifted pictures are shown, see :class:`ctm_plugin.report.command.ReportConfig`.
    """

    folder: Path
    config: dict[str, Any]
    metrics: dict[str, Any]
    setting: Setting
    rest: dict[str, Any]
    light: str = "auto"

    @property
    def scene(self) -> str:
        return self.metrics["dataset"]

    @property
    def seed(self) -> int:
        return self.config["seed"]

    @property
    def aligned(self) -> bool:
        """Whether it is of patches that were aligned, not of views."""
        return is_aligned(self.metrics)

    @property
    def converged(self) -> bool:
        return self.metrics.get("converged") is not False

    def value(self, metric: str) -> float | None:
        """A score; ``None`` where it is none, NaN included, or so large that means would overflow."""
        value = self.metrics.get(metric)
        return float(value) if is_number(value) and abs(value) < LARGEST else None


def has_appearances(runs: Sequence[Run]) -> bool:
    """Whether some runs hold apart how their pictures were exposed."""
    return any(run.setting.appearance != "none" for run in runs)


def is_aligned(metrics: dict[str, Any]) -> bool:
    return "warp_error" in metrics


class Found(NamedTuple):
    """Runs below some folders."""

    runs: list[Run]
    left_out: list[str]
    """Folders of other runs, each with the reason: no scores yet, the error that a sweep saw, damaged, doubled."""


def find_runs(folders: Sequence[Path]) -> Found:
    """All runs in folders and below them that can be reported on, and what is left out.

    Raises:
        CheckpointError: a folder is missing or holds no run.
    """
    found: dict[Path, Run | str] = {}
    for folder in folders:
        if not folder.is_dir():
            raise CheckpointError(folder, "no such directory", "a run directory, or a folder of them")
        paths = sorted({path.parent for name in (CONFIG, ERROR) for path in folder.rglob(name)})
        if not paths:
            raise CheckpointError(folder, f"no {CONFIG} in it or below", "a run directory, or a folder of them")
        for run in paths:
            if run.resolve() not in found:
                found[run.resolve()] = _run_or_reason(run)
    runs = [run for run in found.values() if isinstance(run, Run)]
    runs, doubles = without_doubles(set_apart(runs))
    return Found(runs, [why for why in found.values() if isinstance(why, str)] + doubles)


def _run_or_reason(folder: Path) -> Run | str:
    """A run, or why it is none that can be reported on."""
    try:
        check_folder(folder)
        return read_run(folder) if (folder / METRICS).exists() else _why_unfinished(folder.resolve())
    except CheckpointError as error:
        return str(error)


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


def agree(one: Setting, other: Setting) -> bool:
    """Tell whether two settings have the same values of what sets apart runs of both kinds."""
    values = dict(other.others)
    return all(values.get(key, value) == value for key, value in one.others)


def without_doubles(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Keep the first of runs that are one and the same, by scene, seed, setting and data; tell of the others."""
    first: dict[tuple, Run] = {}
    told = []
    for run in runs:
        same = (run.scene, run.seed, run.setting, run.metrics["protocol"], str(run.metrics.get("data")))
        other = first.setdefault(same, run)
        if other is not run:
            told.append(f"{run.folder}: the same run as {other.folder}, which is taken")
    return list(first.values()), told


def _why_unfinished(folder: Path) -> str:
    if not (folder / ERROR).is_file():
        return f"{folder}: not finished"
    with (folder / ERROR).open(encoding="utf-8", errors="replace") as file:
        return "\n".join(printable(line) for line in f"{folder}: {file.read(TOLD).strip()}".splitlines())


def read_run(folder: Path) -> Run:
    """One finished run; nothing in its files is interpreted.

    Raises:
        CheckpointError: a file cannot be read, or says too little.
    """
    config, metrics = read_yaml(folder / CONFIG), read_json(folder / METRICS)
    missing = [key for key in ("protocol", "dataset", "steps") if key not in metrics]
    if missing:
        raise CheckpointError(folder / METRICS, f"nothing for {', '.join(missing)}", "a run's scores")
    try:
        check_metrics(metrics)
    except ValueError as error:
        raise CheckpointError(folder / METRICS, f"a gap ({error})", "a run's scores") from error
    try:
        run = Run(folder, config, metrics, setting_of(config, is_aligned(metrics)), rest_of(config))
        _check("seed", config["seed"], isinstance(config["seed"], int) and config["seed"] >= 0)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise CheckpointError(folder / CONFIG, f"a gap ({error})", "a run's configuration") from error
    return run


def _check(key: str, value: Any, good: bool) -> None:
    if not good:
        raise ValueError(f"{key} is {reprlib.repr(value)}")


def check_metrics(metrics: dict[str, Any]) -> None:
    """Refuse scores with names that are none; a view's is that of a file in ``test/``.

    Raises:
        ValueError: there is such a name.
    """
    for key in ("protocol", "dataset"):
        _check(key, metrics[key], isinstance(metrics[key], str))
    _check("steps", metrics["steps"], isinstance(metrics["steps"], int))
    rows = metrics.get("per_image") or []
    _check("per_image", rows, isinstance(rows, list))
    for row in rows:
        name = row.get("name") if isinstance(row, dict) else None
        _check("a view's name", name, isinstance(name, str) and name not in ("", "..") and Path(name).name == name)


def setting_of(config: dict[str, Any], aligned: bool) -> Setting:
    """What a table may vary, of the configuration of a run of views, or of patches that were ``aligned``.

    Raises:
        KeyError, TypeError, AttributeError, ValueError: it is no run's.
    """
    setting = _setting_of(config, aligned)
    for key, value in setting._asdict().items():
        if key in ("P", "k"):
            _check(f"ctm.{key}", value, value is None or isinstance(value, int))
        elif key not in ("without", "others"):
            _check(key, value, isinstance(value, str) or (key == "encoding" and value is None))
    return setting


def _loss(config: dict[str, Any]) -> Any:
    """The distance between colours, ``mse`` where it is the one that goes with them anyway."""
    kind, own = config["loss"]["kind"], config["ctm"].get("photometric", "mse")
    if own == "mse":
        return kind
    return "mse" if kind == own else f"{kind}, said"


def _setting_of(config: dict[str, Any], aligned: bool) -> Setting:
    backbone, ctm, space = config["backbone"], config["ctm"], dict(config["color_space"])
    common = {
        "backbone": backbone["name"],
        "color_space": " ".join([space.pop("name"), *(f"{key}={value}" for key, value in space.items())]),
        "loss": _loss(config),
        "encoding": backbone.get("encoding"),
        "appearance": _appearance(config)["name"],
    }
    if ctm["name"] == "none":
        return Setting(ctm="off", **common)
    # An alignment has no use for the random colours: there their weights are 0 in every preset.
    weighed = ("enc", "dec", "img") if aligned else ("enc", "dec", "img", "rand", "latent")
    without = frozenset(term for term in weighed if ctm.get("weights", {}).get(term) == 0)
    return Setting(ctm=ctm.get("preset", ctm["name"]), without=without, P=ctm.get("P"), k=ctm.get("k"), **common)


def _appearance(config: dict[str, Any]) -> dict[str, Any]:
    return config.get("appearance", {"name": "none"})  # runs from before there was a choice


def rest_of(config: dict[str, Any]) -> dict[str, Any]:
    """Everything else that scores depend on: without seeds, paths, and how often something is logged."""
    ctm = {key: value for key, value in config["ctm"].items() if key not in ("P", "k", "weights")}
    ctm["weights"] = {term: weight for term, weight in config["ctm"].get("weights", {}).items() if weight}
    elsewhere = ("root", "image", "seed", "scene", "background_level")
    return {
        "backbone": {key: value for key, value in config["backbone"].items() if key != "encoding"},
        "ctm": ctm,
        "appearance": _appearance(config),
        "loss.weight": config["loss"].get("weight"),
        "dataset": {key: value for key, value in config["dataset"].items() if key not in elsewhere},
        BACKGROUNDS: config["dataset"].get("background_level"),
        "trainer": {
            key: config["trainer"].get(key) for key in ("precision", "accumulate_grad_batches", "gradient_clip_val")
        },
    }


def check_alike(runs: Sequence[Run]) -> None:
    """Refuse runs whose scores mean different things.

    Runs on one scene must share their protocol, the data set's settings and (scenes with views) its fingerprint, runs
    of one backbone (on scenes of one geometry) its settings and budget, runs of one preset CTM's; LPIPS must be of one
    network.

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
                # Settings are in the fingerprint, too.
                own = (run.scene, run.rest[BACKGROUNDS]) if key == "data" else ()
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
    """Which runs must share which parts of a configuration: of a backbone, of a transform or appearance there."""
    kind = run.setting.backbone, run.rest["backbone"].get("geometry")
    apart = {"ctm": run.setting.ctm, "appearance": run.setting.appearance}
    return [
        (kind, ("backbone", "loss.weight", "trainer")),
        *(((*kind, *each), each[:1]) for each in apart.items()),
        ((*kind, BACKGROUNDS, run.setting.ctm, run.scene), (BACKGROUNDS,)),
    ]


def _compare(run: Run, other: Run, parts: Sequence[str]) -> None:
    rows = {key for key, _ in run.setting.others}  # told apart by rows
    for part in parts:
        for key, mine, theirs in _differences(run.rest[part], other.rest[part], part):
            if key not in rows:
                raise _mixed(run, other, f"{key}={mine}", str(theirs))


def _differences(a: Any, b: Any, key: str):
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
