"""Names of ours, names added at run time, names of other packages."""

import sys
from dataclasses import is_dataclass
from fractions import Fraction
from importlib.metadata import EntryPoint
from types import ModuleType

import lightning as L
import pytest

from ctm_plugin.appearance.exposure import Exposure
from ctm_plugin.backbones.base import Backbone
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.errors import CTMError, UnknownNameError
from ctm_plugin.loggers.base import RunLogger
from ctm_plugin.settings import registry
from ctm_plugin.settings.registry import REGISTRIES, Registry

GROUP = "ctm_plugin.shapes"


class Square:
    """What other packages bring."""


@pytest.fixture
def shapes() -> Registry:
    return Registry("shape", GROUP, {"round": "fractions:Fraction", "absent": "no_such_module:Thing"})


@pytest.fixture
def package(monkeypatch):
    """Another package, installed: its module and its entry points."""
    module = ModuleType("their_package")
    module.Square = Square
    monkeypatch.setitem(sys.modules, "their_package", module)
    entries = [
        EntryPoint("square", "their_package:Square", GROUP),
        EntryPoint("broken", "their_package:Triangle", GROUP),
        EntryPoint("lost", "their_other_package:Square", GROUP),
        EntryPoint("round", "their_package:Square", GROUP),
        EntryPoint("other", "their_package:Square", "another.group"),
    ]

    def find(*, group: str) -> list[EntryPoint]:
        return [entry for entry in entries if entry.group == group]

    monkeypatch.setattr(registry, "entry_points", find)


def test_ours_is_imported_when_asked_for(shapes):
    assert shapes.get("round") is Fraction
    with pytest.raises(ModuleNotFoundError, match="no_such_module"):
        shapes.get("absent")


def test_unknown_name_lists_the_known(shapes, package):
    shapes.register("oval", Square)
    with pytest.raises(UnknownNameError) as caught:
        shapes.get("rund")
    assert str(caught.value) == "unknown shape 'rund'; known: absent, broken, lost, oval, round, square"


def test_register(shapes):
    shapes.register("oval", Square)
    assert shapes.get("oval") is Square
    assert shapes.names() == ["absent", "oval", "round"]


@pytest.mark.parametrize("name", ["round", "oval", "square"], ids=["ours", "added", "theirs"])
def test_a_name_is_registered_once(shapes, package, name):
    shapes.register("oval", Square)
    with pytest.raises(CTMError, match=f"shape '{name}' is registered already"):
        shapes.register(name, object)
    assert shapes.get("oval") is Square


def test_another_package(shapes, package):
    assert shapes.get("square") is Square
    assert shapes.names() == ["absent", "broken", "lost", "round", "square"]


def test_another_package_cannot_take_our_name(shapes, package):
    assert shapes.get("round") is Fraction
    assert sorted(shapes.others()) == ["broken", "lost", "square"]


@pytest.mark.parametrize(("name", "why"), [("broken", "AttributeError"), ("lost", "ModuleNotFoundError")])
def test_another_package_that_cannot_be_imported(shapes, package, name, why):
    with pytest.raises(CTMError, match=rf"shape '{name}' \(their_\w+:\w+\) cannot be imported: {why}"):
        shapes.get(name)


def test_settings_of_ours_are_found_without_the_class(tmp_path, monkeypatch):
    """As it names them, in another module or in its own, which only then is imported."""
    (tmp_path / "their_settings.py").write_text("class OneConfig: pass\n")
    of_one = "from their_settings import OneConfig\n\n\nclass Space:\n    Config = OneConfig\n"
    (tmp_path / "space_of_one.py").write_text(of_one)
    (tmp_path / "space_of_two.py").write_text("class TwoConfig: pass\nclass Space:\n    Config = TwoConfig\n")
    monkeypatch.syspath_prepend(tmp_path)
    spaces = Registry("space", GROUP, {name: f"space_of_{name}:Space" for name in ("one", "two")})
    assert spaces.settings("one").__name__ == "OneConfig"
    assert "space_of_one" not in sys.modules
    assert spaces.settings("two") is spaces.get("two").Config


BASES = {
    "backbone": Backbone, "ctm": ColorTransform, "color_space": ColorTransform, "appearance": Exposure,
    "logger": RunLogger, "callbacks": L.Callback,
}  # fmt: skip


@pytest.mark.parametrize("group", REGISTRIES)
def test_all_of_ours_can_be_imported(group):
    kind = REGISTRIES[group]
    assert kind.ours
    for name in kind.ours:
        thing = kind.get(name)
        assert is_dataclass(config := getattr(thing, "Config", thing))
        assert kind.settings(name) is config or not hasattr(thing, "Config")
        assert callable(thing.load) if group == "dataset" else issubclass(thing, BASES[group])
