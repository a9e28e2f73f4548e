"""Hydra composes the same in two thirds of the time: what it would ask, copy or read twice, it does once.

Most tests of the command line, and every command of the documentation, are little else than a composition: 142 ms, and
208 without this. ``test_conf``, ``test_cli``, ``test_mistakes``, ``compose`` and ``settings`` take 82 s of a processor,
and 116 without this; nearly all of their compositions differ, so that sharing them gains nothing.
"""

import copy
from collections.abc import Sequence
from typing import Any

import pytest
from hydra._internal import defaults_list
from hydra._internal.config_repository import CachingConfigRepository
from omegaconf import _utils
from yaml.constructor import SafeConstructor
from yaml.resolver import Resolver

try:
    from yaml.cyaml import CParser
except ImportError:  # PyYAML built without libyaml
    CParser = None


def quicken(patch: pytest.MonkeyPatch) -> None:
    """Replace what is done twice for as long as ``patch`` lasts."""
    patch.setattr(CachingConfigRepository, "__init__", share)
    patch.setattr(defaults_list, "_create_interpolation_map", remembered(defaults_list._create_interpolation_map))
    if CParser is not None:
        loader = quick_loader(_utils.get_yaml_loader())
        patch.setattr(_utils, "get_yaml_loader", lambda: loader)


def share(self: CachingConfigRepository, delegate: Any) -> None:
    """Copy the list of sources alone, not every choice that is registered: each is copied when it is asked for."""
    self.delegate, self.cache = copy.copy(delegate), {}


def remembered(own: Any) -> Any:
    """Make the choices that a defaults list may refer to once for the same choices."""
    made = {}

    def named(default: Any) -> Any:
        group = isinstance(default, defaults_list.GroupDefault)
        return (default.get_override_key(), default.value) if group else default.get_config_path()

    def create(overrides: Any, defaults: Sequence[Any], self_added: bool) -> Any:
        listed = [named(each) for each in defaults if not (self_added and each.is_self())]
        key = repr((overrides.known_choices, listed))
        if key not in made:
            made[key] = own(overrides, defaults, self_added)
        return made[key]

    return create


def quick_loader(own: type) -> type:
    """Parse YAML by libyaml; its values are made by OmegaConf's loader."""

    class Loader(CParser, own):
        def __init__(self, stream: Any):
            CParser.__init__(self, stream)
            SafeConstructor.__init__(self)
            Resolver.__init__(self)

    return Loader
