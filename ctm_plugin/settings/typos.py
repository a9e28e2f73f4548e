"""Mistyped choices and keys of a command line, found by file names and source: nothing heavy is imported for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

from hydra.core.override_parser.types import ChoiceSweep, Override
from omegaconf import OmegaConf

from ctm_plugin.settings.build import SECTIONS, unknown_choice, unknown_key
from ctm_plugin.settings.listing import names
from ctm_plugin.settings.registry import REGISTRIES, SETTINGS, TRAINING
from ctm_plugin.settings.source import keys_of

ROOT = (*SECTIONS, "resume", "seed", "sweep")
"""What stands at the top of a configuration, but for Hydra's own part."""


def check_typos(given: Sequence[Override], conf: Path, groups: Sequence[str]) -> None:
    """Refuse choices that no group has, and keys that no class of ours has under the choices that are made.

    What other packages bring is left to Hydra, which finds the rest when all is composed.

    Raises:
        ConfigError: there is such a name.
    """
    given = [each for each in given if not each.is_delete()]
    chosen = {each.key_or_group: _chosen(each) for each in given if each.key_or_group in groups}
    for group, choices in chosen.items():
        for choice in set(choices).difference(known := names(conf, group)):
            raise unknown_choice(group, choice, known)
    keys = {section: _keys(section, _kinds(section, chosen, conf)) for section in SECTIONS}
    everywhere = [f"{section}.{key}" for section, known in keys.items() for key in known]
    folders = {path.name for path in conf.iterdir()}  # such as budget, which nobody needs to name
    for each in given:
        section, dot, key = each.key_or_group.partition(".")
        if each.package is not None or {"/", "@"} & set(each.key_or_group):
            continue
        if section not in {*ROOT, *folders}:
            raise unknown_key(section, ROOT, everywhere)
        if dot and keys.get(section):
            _check_key(section, key.split("."), keys[section], everywhere)


def _check_key(section: str, parts: Sequence[str], known: Sequence[str], everywhere: Sequence[str]) -> None:
    """Go down a dotted key as far as ``known`` ones go; below a setting there may be anything."""
    if section == "callbacks" and parts[0] not in REGISTRIES[section].ours:
        return
    for depth, part in enumerate(parts):
        above = "".join(f"{each}." for each in parts[:depth])
        if above.rstrip(".") in known:
            return
        there = dict.fromkeys(key[len(above) :].partition(".")[0] for key in known if key.startswith(above))
        if part not in there:
            raise unknown_key(f"{section}.{above}{part}", there, everywhere)


def _chosen(override: Override) -> list[str]:
    """The names that a group is given, one or those of a sweep, but for those that are yet to be found."""
    value = override.value()
    values = value.list if isinstance(value, ChoiceSweep) else [] if override.is_sweep_override() else [value]
    chosen = [str(getattr(each, "text", each)) for each in values]  # quoted ones have a text
    return [name for name in chosen if "${" not in name]


def _kinds(section: str, chosen: Mapping[str, Sequence[str]], conf: Path) -> list[str]:
    """The choices whose keys a section may have: as given or by default; all, where an experiment may choose."""
    if section in chosen:
        return list(chosen[section])
    if set(chosen.get("experiment", ())) - {"none"} or (section == "dataset" and "backbone" in chosen):
        return names(conf, section)
    return [each[section] for each in _defaults(conf) if section in each]


@cache
def _defaults(conf: Path) -> list[dict[str, str]]:
    """The choices that a command line without any has."""
    listed = OmegaConf.to_container(OmegaConf.load(conf / "config.yaml"))["defaults"]
    return [each for each in listed if isinstance(each, Mapping)]


def _keys(section: str, kinds: Sequence[str]) -> list[str]:
    """The dotted keys of a section; none: they are not for us to say."""
    registry = REGISTRIES.get(section)
    if registry is None:
        return keys_of(SETTINGS[section])
    if section == "callbacks":
        return [f"{name}.{key}" for name, entry in registry.ours.items() for key in keys_of(entry)]
    if section == "ctm":  # its files are presets of one class, where they are none of another
        kinds = [kind if kind in registry.ours else "ctm" for kind in kinds if kind != "off"]
    if not all(kind in registry.ours for kind in kinds):
        return []
    entries = [registry.ours[kind] for kind in kinds] + [TRAINING] * (section == "ctm" and bool(kinds))
    found = [key for entry in entries for key in keys_of(entry)]
    return [*dict.fromkeys(found), "name", *["preset"] * (section == "ctm")] if found else []
