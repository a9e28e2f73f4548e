"""Hydra's choices out of dataclasses: each registered name, and the defaults that the files in ``conf/`` start from."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf.errors import OmegaConfBaseException

from ctm_plugin.compose.checks import kind_of
from ctm_plugin.errors import ConfigError, CTMError, DataError
from ctm_plugin.settings.as_typed import as_typed, bare, is_sweep, values_of
from ctm_plugin.settings.build import SECTIONS
from ctm_plugin.settings.registry import CALLBACKS, CTM_SETTINGS, DATASETS, PRESET_SETTINGS, REGISTRIES, conf_dir, load
from ctm_plugin.settings.setting import defaults, meanings

GROUPS = (*(section for section in SECTIONS if section != "metrics"), "experiment")
"""Groups of choices by their names on a command line."""


def normalise(arguments: Sequence[str]) -> list[str]:
    """Take the ``+`` off group choices, and put text into quotes where Hydra would read something else.

    Every group has a default, so that ``+backbone=dvgo`` would be a second choice. Only a single ``+`` before a group's
    own name goes: ``++x=1``, ``~group`` and ``+group.key=v`` pass.

    Example:
        >>> normalise(["+backbone=dvgo", "+backbone.width=3", "dataset.root=1e5"])
        ['backbone=dvgo', '+backbone.width=3', "dataset.root='1e5'"]
    """
    prefixes, sweep = tuple(f"+{group}=" for group in GROUPS), is_sweep(arguments)
    plain = (argument[1:] if argument.startswith(prefixes) else argument for argument in arguments)
    return [as_typed(argument, sweep) for argument in plain]


def node(group: str, name: str = "") -> dict[str, Any]:
    """Lay out the YAML of a group's choice with all keys and defaults; without a name, of the whole group."""
    return _each(group, name, defaults)


def key_meanings(group: str, name: str = "") -> dict[str, str]:
    """The meanings of a group's keys, by dotted name."""
    return _each(group, name, meanings)


def _each(group: str, name: str, what: Callable[[type], dict[str, Any]]) -> dict[str, Any]:
    if group == "callbacks" and not name:
        callbacks = {each: what(CALLBACKS.settings(each)) for each in CALLBACKS.ours}
        dotted = {f"{above}.{key}": words for above, inner in callbacks.items() for key, words in inner.items()}
        return callbacks if what is defaults else dotted
    if group not in PRESET_SETTINGS and group not in REGISTRIES:
        return {}
    return {**what(kind_of(group, name)), **(what(load(CTM_SETTINGS)) if group == "ctm" and name != "none" else {})}


def register(chosen: Iterable[str] | None = None) -> None:
    """Store in Hydra all choices that are no files: each registered name, and ``settings``, the files' defaults.

    Names of this package, of others and of the running program come the same way; a name that has gone from its
    registry is no choice any more.

    Args:
        chosen: a command line. Names of other packages that it does not contain are stored without keys, as their
            import may take long; ``None``: all are imported.
    """
    words = None if chosen is None else set(re.findall(r"\w+", " ".join(chosen)))
    for group in (*PRESET_SETTINGS, "callbacks"):
        _store("settings", group, node(group))
    for group, registry in REGISTRIES.items():
        stored = ConfigStore.instance().repo.get(group, {})
        for gone in stored.keys() - {f"{name}.yaml" for name in registry.names()}:
            del stored[gone]
        for name in registry.names():
            choice = {"name": name}
            ours = name in registry.ours
            if ours or words is None or name in words:
                with suppress(CTMError, OmegaConfBaseException):  # raised when it is asked for
                    choice |= node(group, name)
                    if data := getattr(registry.settings(name), "default_dataset", None):
                        choice["defaults"] = [{"override /dataset@_global_.dataset": data}]
            if group == "callbacks":
                if not ours:  # ours are one file
                    given = {key: value for key, value in choice.items() if key != "name"}
                    _store(group, name, {"defaults": ["default", "_self_"], name: given})
            elif group == "ctm" and (name == group or (conf_dir() / group / f"{name}.yaml").is_file()):
                _store("settings", name, choice)  # of auto, and of on and its variants, which are files
            else:
                _store(group, name, choice | ({"preset": name} if group == "ctm" else {}))


def with_usual_backbone(arguments: Sequence[str]) -> list[str]:
    """Add the data set's ``default_backbone`` to a command line that names neither a backbone nor an
    experiment.

    Hydra's defaults list cannot: of two groups only the later may choose the other, and the backbone already chooses
    by its ``default_dataset``.
    """
    arguments_left = []
    for argument in arguments:
        group, _, name = argument.partition("=")
        if group in ("backbone", "experiment"):
            return list(arguments)
        arguments_left.append(argument)
        if group == "dataset":
            with suppress(CTMError):  # raised when it is composed
                (usual, *others) = {
                    getattr(DATASETS.settings(each), "default_backbone", None) for each in name.split(",")
                }
                arguments_left += [f"backbone={usual}"] if usual and not others else []
    return arguments_left


def with_fitting_dataset(arguments: Sequence[str]) -> list[str]:
    """Add the data set that reads ``dataset.root`` to a command line that names neither a data set nor an experiment.

    Raises:
        DataError: no data set reads the folder.
        ConfigError: a sweep's folders are of several layouts.
    """
    given = {key.lstrip("+"): value for key, _, value in (argument.partition("=") for argument in arguments)}
    if "dataset.root" not in given or given.keys() & {"dataset", "experiment"}:
        return list(arguments)
    from ctm_plugin.data.readers.folders import require_folder
    from ctm_plugin.data.readers.layouts import LAYOUT_EXPECTED, layouts, way_out

    fitting = set()
    expected = f"a folder that one of dataset={', '.join(LAYOUT_EXPECTED)} reads"
    values = values_of(given["dataset.root"]) if is_sweep(arguments) else [given["dataset.root"]]
    for name in (name for value in values for name in bare(value)):
        root = require_folder(name, expected)
        if not (names := layouts(root)):
            raise DataError(root, "no cameras", "; ".join(filter(None, (expected, way_out(root)))))
        fitting.add(names[0])
    if len(fitting) > 1:
        raise ConfigError("dataset", "none", f"a sweep each: the folders are for {', '.join(sorted(fitting))}")
    return [f"dataset={fitting.pop()}", *arguments]


_STORED: dict[tuple[str, str], dict[str, Any]] = {}


def _store(group: str, name: str, choice: dict[str, Any]) -> None:
    """Put a choice into Hydra's store, unless it is there already: every run of a sweep asks again."""
    store = ConfigStore.instance()
    if f"{name}.yaml" not in store.repo.get(group, {}) or _STORED.get((group, name)) != choice:
        store.store(group=group, name=name, node=choice)
        _STORED[group, name] = choice
