"""From a composed configuration to typed settings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, fields, is_dataclass
from difflib import get_close_matches
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from omegaconf import BooleanNode, FloatNode, IntegerNode, OmegaConf, StringNode
from omegaconf.errors import ValidationError

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
NODES = {int: IntegerNode, float: FloatNode, bool: BooleanNode, str: StringNode}
"""OmegaConf's checks and conversions of values by type."""
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
    hints, own = get_type_hints(settings), {each.name: each for each in fields(settings)}
    if unknown := next((name for name in node if name not in own), None):
        raise unknown_key(_below(key, unknown), [*own, *also])
    try:
        given = {name: value for name, value in node.items() if value != "???"}
        values = {name: _value(value, hints[name], _below(key, name)) for name, value in given.items()}
    except RecursionError as error:
        raise ConfigError(key, Words("lists or mappings nested too deeply"), "plain values") from error
    for name, each in own.items():
        if name not in values and each.default is each.default_factory is MISSING:
            parts = filter(None, ("a value", meanings(settings).get(name)))
            raise ConfigError(_below(key, name), Words("nothing"), ": ".join(parts))
    return settings(**values)


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


def _value(value: Any, hint: Any, key: str) -> Any:
    """A value of a field's type: ``1`` and text of a number may stand for a float, lists become tuples."""
    if is_dataclass(hint):
        if isinstance(value, Mapping):
            return build(hint, value, key)
        raise ConfigError(key, value, f"a mapping with {', '.join(sorted(each.name for each in fields(hint)))}")
    kinds = get_args(hint) if isinstance(hint, UnionType) else (hint,)
    if get_origin(hint) in (tuple, list) and isinstance(value, Sequence) and not isinstance(value, str):
        return tuple(_value(each, get_args(hint)[0], f"{key}[{place}]") for place, each in enumerate(value))
    if type(value) in kinds or Any in kinds or (Path in kinds and isinstance(value, Path)):
        return value
    single = [kind for kind in kinds if kind is not NoneType]
    if len(single) == 1 and single[0] in NODES and not (isinstance(value, str) and "${" in value):
        with suppress(ValidationError):
            return NODES[single[0]](value, is_optional=False)._value()
    kinds = [kind for kind in kinds if kind is not int or float not in kinds]
    raise ConfigError(
        key, value, " or ".join(dict.fromkeys(TYPES.get(get_origin(kind) or kind, "text") for kind in kinds))
    )
