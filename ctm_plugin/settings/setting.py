"""A setting: its default, its meaning and what it may be, in one place; and the dataclasses that hold settings."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass
from types import NoneType
from typing import Any, ClassVar, NamedTuple, get_args, get_type_hints

from omegaconf import OmegaConf

from ctm_plugin.errors import ConfigError

Number = float | int
"""A real number in a configuration file: ``exposure: 1`` is an int."""
REQUIRED: Any = MISSING
"""The default of a :func:`setting` that must be given."""
MAX_INT = 2**31 - 1
"""Largest integer of any setting."""
RULES = ("least", "most", "above", "below", "choices")


class Allowed(NamedTuple):
    """Allowed values of a setting: one of ``choices``, or a number in a range, with or without its ends."""

    integer: bool
    null: bool
    low: Number | None = None
    high: Number | None = None
    open_low: bool = False
    open_high: bool = False
    choices: tuple[Any, ...] = ()

    def __contains__(self, value: object) -> bool:
        if (value is None and self.null) or any(type(value) is type(each) and value == each for each in self.choices):
            return True
        if self.low is None or not is_number(value) or (self.integer and not isinstance(value, int)):
            return False
        high = math.inf if self.high is None else self.high
        above = value > self.low if self.open_low else value >= self.low
        return above and (value < high if self.open_high or high == math.inf else value <= high)

    def __str__(self) -> str:
        """Word this for an error: ``an integer, 0 to 3``, ``one of a, b``, ``a number in (0, 1], scene or null``."""
        words = [str(each).lower() if isinstance(each, bool) else str(each) for each in self.choices]
        words += ["null"] * self.null
        if self.low is None:
            return f"one of {', '.join(words)}"
        *before, last = [self._range(), *words]
        return f"{', '.join(before)} or {last}" if before else last

    def _range(self) -> str:
        what = "an integer" if self.integer else "a number"
        if self.high is None or (self.integer and self.high == MAX_INT):
            return f"{what} {'>' if self.open_low else '>='} {self.low:.10g}"
        if self.integer:
            return f"{what}, {self.low} to {self.high}"
        ends = "(" if self.open_low else "[", ")" if self.open_high else "]"
        return f"{what} in {ends[0]}{self.low:.10g}, {self.high:.10g}{ends[1]}"


def setting(
    default: Any, meaning: str, *, composed: str | None = None, only: Mapping[str, Sequence[Any]] | None = None,
    **allowed: Any,
) -> Any:  # fmt: skip
    """Make a dataclass's field with its default, meaning and allowed values.

    Args:
        default: a value that cannot be changed, or ``REQUIRED``.
        meaning: a phrase that can be understood on its own, at most 25 words.
        composed: the default on a command line, an interpolation, where it depends on other keys.
        only: other fields, and the values of each with which this one has an effect, see :func:`idle`.
        allowed: ``least`` and ``most`` of a number, ends that count, or ``above`` and ``below``, ends that do not;
            ``choices``, in place of numbers or besides them. ``null`` is allowed where the type has ``None``. An
            integer has at most 31 bits. TypeError: another rule.
    """
    if unknown := set(allowed) - set(RULES):
        raise TypeError(f"setting() got {', '.join(sorted(unknown))}, expected some of {', '.join(RULES)}")
    metadata = {"meaning": meaning, "composed": composed, "only": only, "allowed": allowed}
    return field(default=default, metadata={name: value for name, value in metadata.items() if value})


def by_geometry(bounded: Any, other: Any, meaning: str, **allowed: Any) -> Any:
    """Make a :func:`setting` with a default of its own on scenes that are not bounded."""
    texts = (str(list(value) if isinstance(value, tuple) else value) for value in (bounded, other))
    return setting(bounded, meaning, composed=f"${{by_geometry:{','.join(texts)}}}", **allowed)


class Settings:
    """Base of dataclasses of settings: values that are not allowed are refused when one is made, in Python too.

    Example:
        >>> @dataclass(frozen=True, kw_only=True)
        ... class BlurConfig(Settings, section="backbone"):
        ...     steps: int = setting(1000, "training steps", least=1)
        >>> BlurConfig(steps=0)
        Traceback (most recent call last):
        ctm_plugin.errors.ConfigError: backbone.steps: found 0, expected an integer >= 1
    """

    section: ClassVar[str] = ""
    """Section of the configuration that holds its keys, for messages."""

    def __init_subclass__(cls, section: str | None = None, **more: Any) -> None:
        super().__init_subclass__(**more)
        if section is not None:
            cls.section = section

    def __post_init__(self) -> None:
        for name, allowed in rules(type(self)).items():
            if getattr(self, name) not in allowed:
                raise self.fault(name, str(allowed))

    def fault(self, name: str, expected: str) -> ConfigError:
        """Make the error for a field's value that cannot be used."""
        value = getattr(self, name)
        key = f"{self.section}.{name}" if self.section else name
        return ConfigError(key, list(value) if isinstance(value, tuple) else value, expected)


@dataclass(frozen=True)
class Nothing(Settings):
    """No settings."""


@functools.cache
def rules(settings: type) -> dict[str, Allowed]:
    """Find the allowed values of a dataclass's dotted keys that restrict them."""
    hints, allowed = get_type_hints(settings), {}
    for each in fields(settings):
        if given := _said(settings, each.name, "allowed"):
            kinds = get_args(hints[each.name]) or (hints[each.name],)
            integer = int in kinds and float not in kinds
            low, high = given.get("least", given.get("above")), given.get("most", given.get("below"))
            if low is not None and integer and high is None:
                high = MAX_INT
            ends = "above" in given, "below" in given
            allowed[each.name] = Allowed(integer, NoneType in kinds, low, high, *ends, tuple(given.get("choices", ())))
    return allowed


@functools.cache
def defaults(settings: type) -> dict[str, Any]:
    """Lay a dataclass's defaults out as in a YAML file with all keys; required keys come first and are ``???``.

    The dictionary is cached: callers must not change it.
    """
    node = OmegaConf.to_container(OmegaConf.structured(settings))
    node |= {each.name: each.metadata["composed"] for each in fields(settings) if "composed" in each.metadata}
    return dict(sorted(node.items(), key=lambda item: item[1] != "???"))


def meanings(settings: type) -> dict[str, str]:
    """Tell the meaning of each key of a dataclass, by dotted name; a field without one has that of its base's field."""
    texts = {}
    for each in fields(settings):
        meaning = _said(settings, each.name, "meaning") or ""
        inner = meanings(type(each.default)) if is_dataclass(each.default) else {}
        texts |= {f"{each.name}.{name}": ": ".join(filter(None, (meaning, words))) for name, words in inner.items()}
        texts |= {} if inner else {each.name: meaning}
    return texts


def idle(settings: Any) -> dict[str, str]:
    """Find the fields that have no effect, by name, each with the reason: ``other=value``, another field's value."""
    only = {each.name: _said(type(settings), each.name, "only") or {} for each in fields(settings)}
    return {
        name: f"{other}={str(value).lower()}"
        for name, needed in only.items()
        for other, values in needed.items()
        if (value := getattr(settings, other)) not in values
    }


def keys(settings: type) -> list[str]:
    """List the dotted keys of a dataclass."""
    return list(meanings(settings))


def _said(settings: type, name: str, what: str) -> Any:
    """Read an entry of a field's metadata, or of the same field in the nearest base that has the entry."""
    for kind in settings.__mro__:
        same: Field | None = getattr(kind, "__dataclass_fields__", {}).get(name)
        if same is not None and what in same.metadata:
            return same.metadata[what]
    return None


def is_number(value: object) -> bool:
    """Tell whether ``value`` is an int or a float; bools are not numbers here."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)
