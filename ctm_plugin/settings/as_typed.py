"""Names of files and folders as they were typed, put into quotes for Hydra's grammar."""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from types import NoneType
from typing import get_args, get_type_hints

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Quote, QuotedString
from hydra.errors import HydraException

from ctm_plugin.errors import CTMError
from ctm_plugin.settings.registry import PRESET_SETTINGS, REGISTRIES, load

HYDRA_FOLDERS = ("hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir")
"""Keys of the folders that Hydra writes to; Hydra does not sweep over their values."""
HYDRA_VALUES = re.compile(r"null|(?P<quote>['\"]).*(?P=quote)|(choice|glob|shuffle|sort|tag|str)\(.*\)", re.DOTALL)
"""Pattern of values that Hydra reads itself, unless a file has such a name."""


@functools.cache
def grammar() -> OverridesParser:
    """Parser of Hydra's grammar, which reads every ``key=value``."""
    return OverridesParser.create()


def is_sweep(arguments: Iterable[str]) -> bool:
    """Tell whether a command line asks for several runs."""
    return any(argument in ("-m", "--multirun") or argument.startswith("hydra.mode=") for argument in arguments)


def as_typed(argument: str, sweep: bool) -> str:
    """Quote the value of a ``key=value`` whose key holds text, so that Hydra takes it for no number, list or the like.

    Commas separate values if ``sweep`` or if all are existing files, but not within an existing file's name.

    Example:
        >>> as_typed("dataset.root=cap (1)", sweep=False), as_typed("dataset.root=1e5,it's", sweep=True)
        ("dataset.root='cap (1)'", "dataset.root='1e5','it\\\\'s'")
    """
    key, given, value = argument.partition("=")
    name = key.lstrip("+")
    is_path = True if name in HYDRA_FOLDERS else _texts(name.partition(".")[0]).get(name)
    if is_path is None or not given:
        return argument
    values = list(values_of(value))
    a_name = is_path and not (sweep or all(map(_is_there, values)))
    return f"{key}={_quoted(value) if name in HYDRA_FOLDERS or a_name else ','.join(map(_quoted, values))}"


def values_of(text: str) -> Iterator[str]:
    """Split a value at commas, but for those in names of files and folders that exist."""
    if HYDRA_VALUES.fullmatch(text):
        yield text
        return
    parts = text.split(",")
    while parts:
        count = next((n for n in range(len(parts), 1, -1) if _is_there(",".join(parts[:n]))), 1)
        yield ",".join(parts[:count])
        parts = parts[count:]


def bare(text: str) -> list[str]:
    """Read a value without the quotes of Hydra's grammar: the texts it stands for, several for a sweep's choice."""
    if not HYDRA_VALUES.fullmatch(text) or _is_there(text):
        return [text]
    value = grammar().parse_override(f"key={text}").value()
    named = [getattr(each, "text", each) for each in (value.list if isinstance(value, ChoiceSweep) else [value])]
    return named if all(isinstance(each, str) for each in named) else [text]


def _quoted(text: str) -> str:
    if HYDRA_VALUES.fullmatch(text) and not _is_there(text):
        return text
    with suppress(HydraException):
        if grammar().parse_override(f"key={text}").value() == text:
            return text
    return QuotedString(text, Quote.single).with_quotes()


def _is_there(text: str) -> bool:
    return bool(text) and os.path.exists(os.path.expanduser(text))


def _texts(section: str) -> dict[str, bool]:
    """Dotted keys of a section, under all its choices, whose values are text, and whether that may be a path."""
    registry, keys = REGISTRIES.get(section), {}
    for name in registry.names() if registry else [section] * (section in PRESET_SETTINGS):
        with suppress(CTMError):  # raised when it is asked for
            settings = registry.settings(name) if registry else load(PRESET_SETTINGS[section])
            below = f"{section}.{name}." if section == "callbacks" else f"{section}."
            for key, hint in get_type_hints(settings).items():
                kinds = {*(get_args(hint) or (hint,))} - {NoneType}
                keys |= {f"{below}{key}": Path in kinds} if kinds and kinds <= {str, Path} else {}
    return keys
