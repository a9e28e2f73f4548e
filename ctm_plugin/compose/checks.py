"""Every key and value of a configuration, checked before torch is imported, a picture read or anything trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeVar

from ctm_plugin.errors import ConfigError
from ctm_plugin.settings.build import SECTIONS, Config, build, unknown_key
from ctm_plugin.settings.registry import CALLBACKS, CTM_SETTINGS, PRESET_SETTINGS, REGISTRIES, load
from ctm_plugin.settings.setting import MAX_INT, Nothing

T = TypeVar("T")


def checked(config: Config, watched: bool = True) -> dict[str, Any]:
    """Build the settings of all sections but ``ctm``: a checked dataclass each, of ``callbacks`` one by each name.

    Args:
        config: the resolved configuration.
        watched: whether loggers and callbacks are needed; scoring does without their packages.

    Raises:
        ConfigError: a key means nothing or is missing, or a value cannot be used.
        CTMError: a name is not known, or its package cannot be imported.
    """
    known = (*SECTIONS, "seed", "resume")
    for key in config:
        if key not in known:
            raise unknown_key(key, known)
    for key in known:
        if key not in config or (key in SECTIONS and not isinstance(config[key], Mapping)):
            raise ConfigError(key, config.get(key), "settings" if key in SECTIONS else "a value")
    if config["resume"] is not None:
        raise ConfigError("resume", config["resume"], "null: a run goes on only by resume=RUN_DIR on the command line")
    seed = config["seed"]
    if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed <= MAX_INT:
        raise ConfigError("seed", seed, "an integer >= 0")
    named = {name: node for name, node in config["callbacks"].items() if node is not None}
    for name, node in named.items():
        if not isinstance(node, Mapping):
            raise ConfigError(f"callbacks.{name}", node, "settings, or null for none of it")
    left_out = ("callbacks", "ctm", *(() if watched else ("logger",)))
    parts = {section: section_of(config, section) for section in SECTIONS if section not in left_out}
    transform_of(config)
    callbacks = {
        name: build(CALLBACKS.settings(name), node, f"callbacks.{name}") for name, node in named.items() if watched
    }
    return {**parts, "callbacks": callbacks}


def section_of(config: Config, section: str) -> Any:
    """Build the settings of one section that has a single dataclass."""
    return build(kind_of(section, name_of(config[section])), choice_settings(config[section]), section)


def transform_of(config: Config) -> tuple[Any, Any]:
    """Build the settings of ``ctm``: how a transform is trained, and its own."""
    node, common = config["ctm"], load(CTM_SETTINGS)
    if name_of(node) == "none":
        return common(), build(Nothing, choice_settings(node), "ctm")
    shared = [each.name for each in fields(common)]
    training = {key: value for key, value in choice_settings(node).items() if key in shared}
    rest = {key: value for key, value in choice_settings(node).items() if key not in shared}
    return build(common, training, "ctm"), build(kind_of("ctm", name_of(node)), rest, "ctm", shared)


def kind_of(section: str, name: str) -> type:
    """Find the dataclass of a section's settings, by the choice's name where each choice has its own."""
    if section in PRESET_SETTINGS:
        return load(PRESET_SETTINGS[section])
    return Nothing if name == "none" else REGISTRIES[section].settings(name)


def name_of(node: Config) -> str:
    return str(node.get("name"))


def choice_settings(node: Config) -> dict[str, Any]:
    """The settings in a group's node: without ``name``, which it is registered under, and ``preset``."""
    return {key: value for key, value in node.items() if key not in ("name", "preset")}


def convert(kind: type[T], settings: Any) -> T:
    """Make an instance of a dataclass out of another one's fields, which have the same names."""
    if isinstance(settings, kind):
        return settings
    return kind(**{each.name: getattr(settings, each.name) for each in fields(settings)})
