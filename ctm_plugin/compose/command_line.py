"""Composition of a run's configuration out of group choices and keys, by Hydra."""

from __future__ import annotations

import errno
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import hydra
from hydra.core.override_parser.types import ChoiceSweep, Override
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from ctm_plugin.compose.checks import checked
from ctm_plugin.compose.choices import GROUPS, normalise, register, with_fitting_dataset, with_usual_backbone
from ctm_plugin.errors import ConfigError, DataError, printable
from ctm_plugin.scene.kinds import AUTO
from ctm_plugin.settings.as_typed import grammar, is_sweep
from ctm_plugin.settings.build import SECTIONS, unknown_choice, unknown_key
from ctm_plugin.settings.listing import names
from ctm_plugin.settings.registry import REGISTRIES, conf_dir
from ctm_plugin.settings.setting import idle, keys

ROOT_KEYS = (*SECTIONS, "resume", "seed", "sweep", "hydra")
"""Keys at the top of a configuration."""
FOLDER_FLAGS = ("-cd", "-cp", "-cn", "--config-", "hydra.searchpath")
"""Prefixes of arguments that make Hydra search other folders for choices too."""
DISK_FULL = ("no room on the disk", "some: make it, then try again; a run goes on by resume=RUN_DIR")
NO_PERMISSION = (
    "no permission",
    "a place to start in where this user may read and write: hydra.run.dir=FOLDER moves a run, out=PATH a verb's files",
)
DISK_ERRORS = dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), DISK_FULL)
"""Pairs of found and expected, for the message of a start that failed on a full disk, by errno."""
DISK_ERRORS |= dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), NO_PERMISSION)
"""Pairs of found and expected, for files that may not be written, by errno."""


def compose(*arguments: str) -> dict[str, Any]:
    """Compose the resolved configuration of a command line of group choices and keys, for programs.

    :func:`explain` words the errors that Hydra raises.
    """
    given = prepared(arguments)
    refuse_several(given)
    from ctm_plugin.compose.decide import decide

    with at_work():
        config = hydra.compose("config", given)
    decide(config)
    return without_hydras(config)


def prepared(arguments: Sequence[str]) -> list[str]:
    """Rewrite a command line so that Hydra can compose it; refuse what Hydra would refuse later or not at all.

    Raises:
        CTMError, HydraException: see :func:`check_choices`.
    """
    given = normalise(with_fitting_dataset(arguments))
    check_choices(given)
    register(None if searches_other_folders(given) else given)
    return with_usual_backbone(given)


def check(arguments: Sequence[str]) -> list[str]:
    """Prepare a command line, and refuse choices, keys and values that cannot be used.

    Of a sweep, the first run is composed, and values are left to each run: others may go on where one is impossible.
    Torch is not imported for it, unless a folder is to be read.

    Raises:
        CTMError, HydraException: a choice, key or value cannot be used.
    """
    ready = prepared(arguments)
    if not searches_other_folders(ready):  # only Hydra itself finds what lies there
        with at_work():
            check_values(composed(ready), ready)
    return ready


def check_values(config: DictConfig, arguments: Sequence[str]) -> None:
    """Refuse keys and values that one run cannot use, and several values where there is no sweep."""
    if not searches_other_folders(arguments):
        settings = without_hydras(config, "bounded")  # the sizes that depend on it are all allowed
        if not is_sweep(arguments):
            checked(settings)
    refuse_several(arguments)


def warn_of_idle(settings: Mapping[str, Any], arguments: Iterable[str]) -> None:
    """Warn of keys on a command line that have no effect with the other settings of their section.

    Args:
        settings: what :func:`ctm_plugin.compose.checks.checked` built.
        arguments: one run's choices and keys.
    """
    given = {each.key_or_group: each.input_line for each in parsed(arguments)}
    for section in settings.keys() - {"callbacks"}:
        for name, why in idle(settings[section]).items():
            if line := given.get(f"{section}.{name}"):
                warnings.warn(f"{line} has no effect with {section}.{why}", stacklevel=2)


def at_work(folder: str | Path | None = None) -> AbstractContextManager[None]:
    """Context with Hydra initialised on the choices in a folder, by default the package's ``conf``."""
    return hydra.initialize_config_dir(os.path.abspath(folder or conf_dir()), "cli", version_base="1.3")


def searches_other_folders(arguments: Sequence[str]) -> bool:
    """Tell whether a command line makes Hydra search other folders for choices too."""
    return any(argument.startswith(FOLDER_FLAGS) for argument in arguments)


def refuse_several(arguments: Sequence[str]) -> None:
    """Refuse several values for one key where there is no sweep.

    Raises:
        ConfigError: a key has several.
    """
    for each in [] if is_sweep(arguments) else parsed(arguments):
        if each.is_sweep_override():
            key, _, value = each.input_line.partition("=")
            a_list = f", {key}=[{value}] is a list" if "," in value else ""
            raise ConfigError(key, value, f"one value; -m before it all makes a run of each{a_list}")


def parsed(arguments: Iterable[str]) -> list[Override]:
    """Parse the overrides of a command line: its arguments without flags and flags' values."""
    given = (each for each in arguments if each.startswith("~") or ("=" in each and not each.startswith("-")))
    return grammar().parse_overrides(list(given))


def composed(arguments: Sequence[str], name: str = "config", whole: bool = False) -> DictConfig:
    """Compose a prepared command line's configuration, with ``auto`` undecided; of a sweep, its first run.

    Args:
        arguments: see :func:`prepared`.
        name: name of the primary configuration file.
        whole: whether the section ``hydra`` is included.
    """
    overrides = []
    for each in parsed(each for each in arguments if whole or not each.startswith("hydra")):
        if each.is_discrete_sweep():
            overrides.append(f"{each.input_line.partition('=')[0]}={next(each.sweep_string_iterator())}")
        elif not each.is_sweep_override():  # others are the sweeper's to refuse
            overrides.append(each.input_line)
    return hydra.compose(name, overrides, return_hydra_config=whole)


def without_hydras(config: DictConfig, geometry: str = AUTO) -> dict[str, Any]:
    """Resolve a configuration to plain containers, without the sections ``hydra`` and ``sweep``.

    Args:
        config: as Hydra composed it.
        geometry: the geometry in place of one that is yet to be found.
    """
    own = OmegaConf.masked_copy(config, [key for key in config if key not in ("hydra", "sweep")])
    if own.dataset.get("geometry") == AUTO:
        own.dataset.geometry = geometry
    return OmegaConf.to_container(own, resolve=True, throw_on_missing=False)


def check_choices(arguments: Sequence[str]) -> None:
    """Refuse arguments that cannot be read, and unknown choices and sections.

    Hydra takes ``true`` for a choice of its own, and of a sweep composes one run after the other.

    Raises:
        ConfigError: an argument, choice or section cannot be used.
    """
    known_here = not searches_other_folders(arguments)
    folders = {path.stem for path in conf_dir().iterdir()}  # such as budget, which nobody needs to name
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals or argument.startswith("-"):
            continue
        try:
            given = grammar().parse_override(argument)
        except HydraException as error:
            why = str(error).partition("\n")[0]
            raise ConfigError(key, value, f"a value that can be read ({why})") from error
        group, section = given.key_or_group, given.key_or_group.partition(".")[0]
        several = given.is_sweep_override()
        if known_here and not {"/", "@"} & set(group) and section not in ROOT_KEYS and group not in folders:
            raise unknown_key(section, ROOT_KEYS, known_keys())
        if group not in GROUPS or given.is_delete():
            continue
        chosen = (
            list(given.value().list) if isinstance(given.value(), ChoiceSweep) else [] if several else [given.value()]
        )
        for choice in (getattr(each, "text", each) for each in chosen):
            known = names(conf_dir(), group)
            if not isinstance(choice, str) or (choice not in known and "${" not in choice and known_here):
                raise unknown_choice(group, value if not isinstance(choice, str) else choice, known)


def known_keys() -> list[str]:
    """List the dotted keys of built-in choices but callbacks, for the guess which key a misplaced one was meant for."""
    names = {
        f"{section}.{key}"
        for section, registry in REGISTRIES.items()
        if section != "callbacks"
        for name in registry.ours
        for key in keys(registry.settings(name))
    }
    return sorted(names)


def explain(error: Exception) -> str:
    """Word an error for users: Hydra's with the known choices or keys, errors of files with a way out."""
    if isinstance(error, OSError) and error.filename is not None and error.errno in DISK_ERRORS:
        fault, expected = DISK_ERRORS[error.errno]
        return str(DataError(error.filename, f"{fault} ({error.strerror})", expected))
    if not isinstance(error, (HydraException, OmegaConfBaseException)):
        return str(error)
    if isinstance(error, MissingConfigException) and error.options and error.missing_cfg_file:
        group, _, name = error.missing_cfg_file.rpartition("/")
        return str(unknown_choice(group, name, sorted(error.options)))
    cause = error.__cause__ or error
    full_key = getattr(cause, "full_key", None)
    parent = getattr(cause, "parent_node", None)
    if full_key and isinstance(parent, DictConfig) and isinstance(cause, ConfigKeyError | ConfigAttributeError):
        return str(unknown_key(full_key, (str(key) for key in parent if key != "hydra"), known_keys()))
    return "\n".join(printable(line) for line in str(error).strip().splitlines())
