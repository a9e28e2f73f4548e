"""What a setting may be: by its range, its choices, null, and how that is told."""

import math
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.errors import ConfigError
from ctm_plugin.settings.registry import PRESET_SETTINGS, REGISTRIES, load
from ctm_plugin.settings.setting import MAX_INT, Settings, idle, meanings, rules, setting


@dataclass(frozen=True, kw_only=True)
class Thing(Settings, section="thing"):
    count: int = setting(3, "how many", least=0, most=5)
    many: int | None = setting(None, "how many at most", least=1)
    share: float = setting(0.5, "which part", above=0, most=1)
    rate: float = setting(1.0, "how fast", above=0)
    level: float | str | None = setting(None, "how bright", least=0, below=1, choices=("scene",))
    either: bool | str = setting("auto", "whether", choices=(True, False, "auto"))
    then: int = setting(1, "how often, if so", least=1, only={"either": (True, "auto")})


@dataclass(frozen=True, kw_only=True)
class Special(Thing):
    share: float = 0.25
    either: bool | str = setting("auto", "whether it is", choices=("auto",))


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("count", 6, "an integer, 0 to 5"),
        ("count", -1, "an integer, 0 to 5"),
        ("count", 2.0, "an integer, 0 to 5"),
        ("count", True, "an integer, 0 to 5"),
        ("count", None, "an integer, 0 to 5"),
        ("many", 0, "an integer >= 1 or null"),
        ("many", MAX_INT + 1, "an integer >= 1 or null"),
        ("share", 0, "a number in (0, 1]"),
        ("share", math.nan, "a number in (0, 1]"),
        ("share", "1", "a number in (0, 1]"),
        ("rate", math.inf, "a number > 0"),
        ("rate", 0.0, "a number > 0"),
        ("level", 1.0, "a number in [0, 1), scene or null"),
        ("level", "sky", "a number in [0, 1), scene or null"),
        ("either", "on", "one of true, false, auto"),
        ("either", 1, "one of true, false, auto"),
    ],
)
def test_what_is_refused(key, value, expected):
    with pytest.raises(ConfigError) as error:
        Thing(**{key: value})
    assert str(error.value) == f"thing.{key}: found {value!r}, expected {expected}"


@pytest.mark.parametrize(
    "taken", [{"count": 5}, {"many": None}, {"many": MAX_INT}, {"share": 1}, {"level": "scene"}, {"either": False}]
)
def test_what_is_taken(taken):
    assert vars(Thing(**taken)) == vars(Thing()) | taken


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_a_range_holds_what_lies_in_it(value):
    assert (value in rules(Thing)["share"]) == (0 < value <= 1)


def test_a_field_that_is_given_again_keeps_what_it_does_not_say():
    assert meanings(Special)["share"] == "which part"
    with pytest.raises(ConfigError, match=r"thing\.share: found 2, expected a number in \(0, 1\]"):
        Special(share=2)
    with pytest.raises(ConfigError, match=r"thing\.either: found True, expected one of auto"):
        Special(either=True)


def test_what_has_no_effect_is_known():
    assert idle(Thing()) == idle(Thing(either=True)) == {}
    assert idle(Thing(either=False)) == {"then": "either=false"}


def test_a_rule_that_is_misspelt():
    with pytest.raises(TypeError, match="got lesat, expected some of least, most, above, below, choices"):
        setting(1, "how many", lesat=0)


def test_every_number_of_ours_has_a_range():
    kinds = [load(entry) for entry in PRESET_SETTINGS.values()]
    kinds += [registry.settings(name) for registry in REGISTRIES.values() for name in registry.ours]
    bare = {
        f"{kind.__name__}.{name}"
        for kind in kinds
        for name, annotation in kind.__dataclass_fields__.items()
        if {"int", "float", "Number"} & {*str(annotation.type).split(" | ")} and name not in rules(kind)
    }
    assert bare == set()
