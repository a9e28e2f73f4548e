"""Keys read from the source are those of the classes."""

from typing import get_type_hints

import pytest

from ctm_plugin.settings import commands
from ctm_plugin.settings.build import meanings
from ctm_plugin.settings.registry import REGISTRIES, SETTINGS, TRAINING, load
from ctm_plugin.settings.source import keys_of, settings_of

OURS = [*SETTINGS.values(), TRAINING, *(entry for each in REGISTRIES.values() for entry in each.ours.values())]


@pytest.mark.parametrize("entry", OURS)
def test_keys_are_those_of_the_dataclass(entry):
    thing = load(entry)
    assert sorted(keys_of(entry)) == sorted(meanings(getattr(thing, "Config", thing)))


@pytest.mark.parametrize("verb", [verb for verb in commands.VERBS.values() if verb.entry])
def test_keys_of_a_verb_are_those_of_its_settings(verb):
    kind = get_type_hints(commands.load(verb.entry)).get("settings", commands.Nothing)
    assert sorted(settings_of(f"ctm_plugin.{verb.entry}")) == sorted(meanings(kind))


def test_what_is_not_ours_has_none():
    assert keys_of("fractions:Fraction") == []
