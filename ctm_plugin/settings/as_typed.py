"""Names of files and folders as they were typed, put into quotes for Hydra's grammar."""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import fields, is_dataclass

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException

from ctm_plugin.errors import CTMError
from ctm_plugin.settings.registry import REGISTRIES, SETTINGS
from ctm_plugin.settings.source import annotations_of

HYDRAS = ("hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir")
"""Folders among Hydra's own keys, which it does not sweep."""
LEFT = re.compile(r"null|(?P<quote>['\"]).*(?P=quote)|(choice|glob|shuffle|sort|tag|str)\(.*\)", re.DOTALL)
"""Values that are Hydra's to read, unless a file has such a name."""


def is_sweep(arguments: Iterable[str]) -> bool:
    """Tell whether a command line asks for several runs."""
    return any(argument in ("-m", "--multirun") or argument.startswith("hydra.mode=") for argument in arguments)


def as_typed(argument: str, sweep: bool) -> str:
    """Quote the value of a ``key=value`` whose key holds text, so that Hydra takes it for no number, list or the like.

    A comma stands between values where ``sweep`` or where each of them is there, but not in the name of what is there.

    Example:
        >>> as_typed("dataset.root=cap (1)", sweep=False), as_typed("dataset.root=1e5,it's", sweep=True)
        ("dataset.root='cap (1)'", "dataset.root='1e5','it\\\\'s'")
    """
    key, _, value = argument.partition("=")
    name = key.lstrip("+")
    annotation = "Path" if name in HYDRAS else _annotations(name.partition(".")[0]).get(name, "")
    if not _is_text(annotation):
        return argument
    values = list(values_of(value))
    a_name = "Path" in annotation and not (sweep or all(map(_is_there, values)))
    return f"{key}={_quoted(value) if name in HYDRAS or a_name else ','.join(map(_quoted, values))}"


def values_of(text: str) -> Iterator[str]:
    """Split at commas, but for those in the names of what is there."""
    if LEFT.fullmatch(text):
        yield text
        return
    parts = text.split(",")
    while parts:
        count = next((n for n in range(len(parts), 1, -1) if _is_there(",".join(parts[:n]))), 1)
        yield ",".join(parts[:count])
        parts = parts[count:]


def _quoted(text: str) -> str:
    if LEFT.fullmatch(text) and not _is_there(text):
        return text
    with suppress(HydraException):
        if OverridesParser.create().parse_override(f"key={text}").value() == text:
            return text
    return QuotedString(text, Quote.single).with_quotes()


def _is_there(text: str) -> bool:
    return bool(text) and os.path.exists(os.path.expanduser(text))


def _is_text(annotation: str) -> bool:
    names = set(re.findall(r"\w+", annotation)) - {"None", "Optional", "Union", "typing", "pathlib"}
    return bool(names) and names <= {"str", "Path"}


def _annotations(section: str) -> dict[str, str]:
    """The annotations of a section's keys, dotted, under all choices that it has."""
    registry, found = REGISTRIES.get(section), {}
    entries = dict(registry.ours) if registry else {"": SETTINGS[section]} if section in SETTINGS else {}
    for name, entry in entries.items():
        below = f"{section}.{name}." if section == "callbacks" else f"{section}."
        found |= {f"{below}{key}": annotation for key, annotation in annotations_of(entry).items()}
    for name in {*registry.others(), *registry.added} if registry else ():
        with suppress(CTMError):  # raised when it is asked for
            thing = registry.get(name)
            kind = getattr(thing, "Config", thing)
            below = f"{section}.{name}." if section == "callbacks" else f"{section}."
            own = fields(kind) if is_dataclass(kind) else ()
            found |= {f"{below}{each.name}": _written(each.type) for each in own}
    return found


def _written(annotation: object) -> str:
    return annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
