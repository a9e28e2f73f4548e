"""``python -m ctm_plugin.scenes render SCENE out=DIR [key=value ...]``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from ctm_plugin.errors import ConfigError, CTMError, UnknownNameError
from ctm_plugin.scenes import SCENES
from ctm_plugin.scenes.render import RenderSettings, render

DEFAULTS = {field.name: field.default for field in fields(RenderSettings)}
USAGE = (
    "usage: python -m ctm_plugin.scenes render SCENE out=DIR "
    + " ".join(f"[{key}={value}]" for key, value in DEFAULTS.items())
    + f"\nscenes: {'; '.join(f'{scene.name} ({scene.summary})' for scene in SCENES.values())}"
)


def parse(arguments: Sequence[str]) -> tuple[Path, RenderSettings]:
    """Read ``key=value`` arguments.

    Args:
        arguments: ``out=DIR`` and any field of :class:`RenderSettings`, each at most once.

    Returns:
        The folder and the settings.

    Raises:
        UnknownNameError: a key is not known.
        ConfigError: an argument is not ``key=value``, a value has the wrong type or range, or ``out`` is missing.
    """
    values: dict[str, str] = {}
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals:
            raise ConfigError("argument", argument, "key=value")
        if key != "out" and key not in DEFAULTS:
            raise UnknownNameError("key", key, ["out", *DEFAULTS])
        if key in values:
            raise ConfigError(key, argument, "a key given once")
        values[key] = value
    out = values.pop("out", "")
    if not out:
        raise ConfigError("out", out, "the folder to render into, as out=DIR")
    typed: dict[str, int | float] = {}
    for key, value in values.items():
        kind = type(DEFAULTS[key])
        try:
            typed[key] = kind(value)
        except ValueError:
            raise ConfigError(key, value, "an integer" if kind is int else "a number") from None
    return Path(out).expanduser(), RenderSettings(**typed)


def main(arguments: Sequence[str]) -> int:
    """Run the command line; returns the exit status: 0; 2 after an error's message; 130 when interrupted."""
    if len(arguments) < 2 or arguments[0] != "render":
        print(USAGE, file=sys.stderr)
        return 2
    try:
        if arguments[1] not in SCENES:
            raise UnknownNameError("scene", arguments[1], SCENES)
        out, settings = parse(arguments[2:])
        render(SCENES[arguments[1]], out, settings)
    except (CTMError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
