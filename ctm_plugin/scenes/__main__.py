"""``python -m ctm_plugin.scenes render SCENE out=DIR [key=value ...]``, ``preset NAME source=DIR out=DIR ...``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from ctm_plugin.errors import ConfigError, CTMError, UnknownNameError
from ctm_plugin.scenes import SCENES
from ctm_plugin.scenes.presets import PRESETS
from ctm_plugin.scenes.render import render
from ctm_plugin.scenes.settings import RenderSettings

DEFAULTS = {field.name: field.default for field in fields(RenderSettings)}
WORDS = {"true": True, "false": False}
USAGE = (
    "usage: python -m ctm_plugin.scenes render SCENE out=DIR "
    + " ".join(f"[{key}={str(value).lower()}]" for key, value in DEFAULTS.items())
    + "\n       python -m ctm_plugin.scenes preset PRESET source=DIR out=DIR [key=value ...]\n"
    + f"scenes: {'; '.join(f'{scene.name} ({scene.summary})' for scene in SCENES.values())}; or a path to a .blend\n"
    + f"presets: {'; '.join(f'{name} ({preset.summary})' for name, preset in PRESETS.items())}"
)


def parse(arguments: Sequence[str], folders: Sequence[str] = ("out",)) -> tuple[list[Path], dict[str, object]]:
    """Read ``key=value`` arguments.

    Args:
        arguments: each of ``folders``, and any field of :class:`RenderSettings`, each at most once.
        folders: keys that name folders; all of them are needed.

    Returns:
        The folders, and the settings that were given, with the types of :class:`RenderSettings`.

    Raises:
        UnknownNameError: a key is not known.
        ConfigError: an argument is not ``key=value``, a value has the wrong type, or a folder is missing.
    """
    values: dict[str, str] = {}
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals:
            raise ConfigError("argument", argument, "key=value")
        if key not in folders and key not in DEFAULTS:
            raise UnknownNameError("key", key, [*folders, *DEFAULTS])
        if key in values:
            raise ConfigError(key, argument, "a key given once")
        values[key] = value
    paths = []
    for key in folders:
        if not values.get(key):
            raise ConfigError(key, values.get(key, ""), f"a folder, as {key}=DIR")
        paths.append(Path(values.pop(key)).expanduser())
    return paths, {key: typed(key, value) for key, value in values.items()}


def typed(key: str, value: str) -> object:
    """A value with the type of its default.

    Raises:
        ConfigError: it is none.
    """
    kind = type(DEFAULTS[key])
    if kind is bool:
        if value not in WORDS:
            raise ConfigError(key, value, "true or false")
        return WORDS[value]
    try:
        return kind(value)
    except ValueError:
        raise ConfigError(key, value, "an integer" if kind is int else "a number") from None


def main(arguments: Sequence[str]) -> int:
    """Run the command line; returns the exit status: 0; 2 after an error's message; 130 when interrupted."""
    if len(arguments) < 2 or arguments[0] not in ("render", "preset"):
        print(USAGE, file=sys.stderr)
        return 2
    command, name, *rest = arguments
    try:
        if command == "render":
            (out,), given = parse(rest)
            render(name, out, RenderSettings(**given))
        else:
            if name not in PRESETS:
                raise UnknownNameError("preset", name, PRESETS)
            (source, out), given = parse(rest, ("source", "out"))
            for scene, target, settings in PRESETS[name].renderings(source, out, given):
                render(scene, target, settings)
    except (CTMError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
