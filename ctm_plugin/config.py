"""From a composed configuration to typed settings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any, TypeVar

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError, MissingMandatoryValue, OmegaConfBaseException

from ctm_plugin.errors import ConfigError

T = TypeVar("T")


def build(settings: type[T], node: Mapping[str, Any], key: str) -> T:
    """An instance of a dataclass from a mapping, with every type checked.

    Args:
        settings: the dataclass; its ``__post_init__`` checks the ranges.
        node: values by field name; fields with defaults may be left out.
        key: where ``node`` stands in the configuration, for messages.

    Raises:
        ConfigError: on an unknown key (the known ones are listed), a missing one, or a value of another type.
    """
    schema = OmegaConf.structured(settings)
    _make_writable(schema)
    try:
        return OmegaConf.to_object(OmegaConf.merge(schema, dict(node)))
    except ConfigKeyError as error:
        raise unknown_key(f"{key}.{error.full_key}", _known(settings, error.full_key)) from error
    except MissingMandatoryValue as error:
        raise ConfigError(f"{key}.{error.full_key}", "nothing", "a value") from error
    except OmegaConfBaseException as error:
        raise ConfigError(f"{key}.{error.full_key}", error.value, f"another type: {error.msg}") from error


def split(node: Mapping[str, Any], *settings: type) -> list[dict[str, Any]]:
    """Share a flat mapping out among dataclasses by their fields; what none has goes to the last one."""
    rest = dict(node)
    shares = []
    for kind in settings[:-1]:
        names = {field.name for field in fields(kind)}
        shares.append({name: rest.pop(name) for name in list(rest) if name in names})
    return [*shares, rest]


def unknown_key(key: str, known: Iterable[str]) -> ConfigError:
    """The error for a key that does not exist."""
    return ConfigError(key, "an unknown key", f"one of {', '.join(sorted(known))}")


def _known(settings: type, full_key: str) -> list[str]:
    node = OmegaConf.structured(settings)
    for part in full_key.split(".")[:-1]:
        node = node[part]
    return [str(name) for name in node]


def _make_writable(node: DictConfig) -> None:
    """Frozen dataclasses make read-only nodes, which could not be merged into."""
    OmegaConf.set_readonly(node, False)
    for name in node:
        child = node._get_node(name)
        if isinstance(child, DictConfig) and not child._is_none() and not child._is_missing():
            _make_writable(child)
