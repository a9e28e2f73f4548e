"""From a composed configuration to typed settings."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import ConfigKeyError, MissingMandatoryValue, OmegaConfBaseException, ValidationError

from ctm_plugin.errors import ConfigError, CTMError, Words
from ctm_plugin.settings.setting import meanings

Config = Mapping[str, Any]
"""A run's resolved configuration, plain containers: :data:`SECTIONS`, a seed, and what to resume."""
SECTIONS = (
    "dataset", "backbone", "ctm", "color_space", "appearance", "loss", "trainer", "metrics", "logger", "callbacks",
)  # fmt: skip
"""Sections of a resolved configuration."""
NO_WORDS, YES_WORDS = ("none", "off", "no", "null", "false", "0"), ("on", "yes", "true", "1")
"""Words that switch a group off, and words that stand for its plain choice."""
TYPES = {int: "an integer", float: "a number", bool: "true or false", str: "text", type(None): "null"}
TYPES |= {tuple: "a list", list: "a list", dict: "a mapping"}
T = TypeVar("T")
Node = Any
"""Type of a configuration's ``DictConfig``, as ``Any`` because beartype warns of that class."""


def _by_geometry(bounded: Any, other: Any, unbounded: Any = None, *, _parent_: Node) -> Any:
    """Resolve ``${by_geometry:A,B,C}``: A where the group's ``geometry`` is bounded or not known, C, if given, where it
    is unbounded, else B.
    """
    if _parent_.geometry in ("bounded", None):
        return bounded
    return unbounded if _parent_.geometry == "unbounded" and unbounded is not None else other


def _by_budget(quick: Any, standard: Any, *, _root_: Node) -> Any:
    """Resolve ``${by_budget:A,B}``: B where the trainer's budget is standard, else A."""
    return standard if OmegaConf.select(_root_, "trainer.budget") == "standard" else quick


def _scene(*, _root_: Node) -> str:
    """Resolve ``${scene:}``: the name of the data set's scene or folder, or of the data set where it has none."""
    node = _root_.get("dataset") or {}
    scene, root, name = (
        None if OmegaConf.is_missing(node, key) else node.get(key) for key in ("scene", "root", "name")
    )
    return str(scene or (root and Path(str(root)).expanduser().resolve().name) or name)


OmegaConf.register_new_resolver("by_geometry", _by_geometry, replace=True)
OmegaConf.register_new_resolver("by_budget", _by_budget, replace=True)
OmegaConf.register_new_resolver("scene", _scene, replace=True)


def build(settings: type[T], node: Mapping[str, Any], key: str, also: Iterable[str] = ()) -> T:
    """Make an instance of a dataclass from a mapping, with every type checked.

    Args:
        settings: the dataclass; its ``__post_init__`` checks the ranges.
        node: values by field name; fields with defaults may be left out.
        key: where ``node`` stands in the configuration, for messages; empty: at the top.
        also: further keys that stand there, for the guess what an unknown key was meant for.

    Raises:
        ConfigError: on an unknown key (with the known ones), a missing one, or a value of another type.
    """
    schema = _schema(settings)
    _check_groups(schema, node, key)
    try:
        return _instance(OmegaConf.merge(schema, dict(node)), key)
    except RecursionError as error:
        raise ConfigError(key, Words("lists or mappings nested too deeply"), "plain values") from error
    except ConfigKeyError as error:
        there = [*_known(settings, error.full_key), *(() if "." in error.full_key else also)]
        raise unknown_key(_below(key, error.full_key), there) from error
    except MissingMandatoryValue as error:
        parts = filter(None, ("a value", meanings(settings).get(error.full_key)))
        raise ConfigError(_below(key, error.full_key), Words("nothing"), ": ".join(parts)) from error
    except OmegaConfBaseException as error:
        # An interpolation's message; its other lines repeat the key and name our classes.
        why = str(error.msg).splitlines()[0]
        of_type = isinstance(error, ValidationError)
        expected = _type_of(settings, error.full_key) if of_type else f"a value that can be found: {why}"
        raise ConfigError(_below(key, error.full_key), error.value, expected) from error


def pairs(arguments: Iterable[str]) -> dict[str, str]:
    """Read the ``key=value`` arguments of a command line.

    Raises:
        CTMError: an argument has no value, or a key is given twice.
    """
    values: dict[str, str] = {}
    for argument in arguments:
        key, _, value = argument.partition("=")
        if not key or not value:
            raise CTMError(f"found {argument!r}, expected key=value")
        if key in values:
            raise ConfigError(key, argument, "a key given once")
        values[key] = value
    return values


def unknown_key(key: str, known: Iterable[str], everywhere: Iterable[str] = ()) -> ConfigError:
    """Make the error for a key that does not exist, with a guess which known key was meant.

    Args:
        key: dotted.
        known: the names that are valid in its place.
        everywhere: dotted keys of all of a configuration: the same name may stand elsewhere.
    """
    names, (above, dot, name) = sorted(known), key.rpartition(".")
    meant = [f"{above}{dot}{each}" for each in near_to(name, names)]
    meant = meant or [each for each in everywhere if each.rpartition(".")[2] == name and each != key]
    expected = f"one of {', '.join(names)}" if names else "no settings"
    return ConfigError(key, Words("an unknown key"), expected + asked(meant))


def unknown_choice(group: str, choice: str, known: Sequence[str]) -> ConfigError:
    """Make the error for a choice that a group does not have, with a guess which known choice was meant."""
    word = choice.lower()
    meant = [name for name in known for words in (NO_WORDS, YES_WORDS) if name in words and word in words]
    return ConfigError(group, choice, f"one of {', '.join(known)}{asked(meant or near_to(choice, known))}")


def near_to(name: str, known: Iterable[str]) -> list[str]:
    """Find the known name, if any, that a mistyped name resembles."""
    names = {each.lower(): each for each in known}
    return [names[each] for each in get_close_matches(name.lower(), names, 1, 0.65) if names[each] != name]


def asked(meant: Sequence[str]) -> str:
    """Word the question at an error's end: did the user mean one of these names?"""
    return f"; did you mean {' or '.join(meant)}?" if meant else ""


def _below(key: str, name: str) -> str:
    return f"{key}.{name}" if key else name


def _type_of(settings: type, full_key: str) -> str:
    """Describe the type that a dotted key, or an item ``[i]`` of its list, may hold."""
    hint: Any = settings
    for part in full_key.split("."):
        name, *item = part.split("[")
        hint = get_type_hints(hint)[name]
        hint = get_args(hint)[0] if item else hint
    kinds = get_args(hint) if isinstance(hint, UnionType) else (hint,)
    kinds = [kind for kind in kinds if kind is not int or float not in kinds]
    return " or ".join(dict.fromkeys(TYPES.get(get_origin(kind) or kind, "text") for kind in kinds))


def _known(settings: type, full_key: str) -> list[str]:
    node = OmegaConf.structured(settings)
    for part in full_key.split(".")[:-1]:
        node = node[part]
    return [str(name) for name in node]


@functools.cache
def _schema(settings: type) -> Node:
    """A dataclass as OmegaConf's structured node, with types and defaults; copy it before merging."""
    schema = OmegaConf.structured(settings)
    _make_writable(schema)
    return schema


def _make_writable(node: Node) -> None:
    """Make a node of frozen dataclasses writable, at all levels, so that values can be merged into it."""
    OmegaConf.set_readonly(node, False)
    for child in _groups(node).values():
        _make_writable(child)


def _check_groups(schema: Node, node: Mapping[str, Any], key: str) -> None:
    """Refuse a single value in a dataclass's place, or a mapping in a list's; OmegaConf would not name the key."""
    for name in schema:
        if isinstance(schema._get_node(name), ListConfig) and isinstance(node.get(name), Mapping):
            raise ConfigError(_below(key, name), node[name], "a list")
    for name, child in _groups(schema).items():
        value = node.get(name, {})
        if isinstance(value, Mapping):
            _check_groups(child, value, _below(key, name))
        else:
            raise ConfigError(_below(key, name), value, f"a mapping with {', '.join(sorted(child))}")


def _groups(node: Node) -> dict[str, Node]:
    children = {name: node._get_node(name) for name in node}
    return {
        name: child
        for name, child in children.items()
        if isinstance(child, DictConfig) and not child._is_none() and not child._is_missing()
    }


def _instance(node: Node, key: str) -> Any:
    """Make a node's dataclass; lists become tuples, as a frozen dataclass should have.

    Raises:
        ConfigError: a list of plain values holds something else, which OmegaConf lets pass.
    """
    values = {}
    for name in node:
        value = node[name]
        if isinstance(value, DictConfig):
            value = _instance(value, _below(key, name))
        elif isinstance(value, ListConfig):
            kind, value = value._metadata.element_type, tuple(OmegaConf.to_object(value))
            if kind in (bool, float, int, str) and any(each is None or isinstance(each, dict | list) for each in value):
                raise ConfigError(_below(key, name), list(value), f"a list of {kind.__name__}")
        values[name] = value
    return OmegaConf.get_type(node)(**values)
