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
from ctm_plugin.compose.command_line import compose, conf_dir
from ctm_plugin.errors import ConfigError, CTMError, UnknownNameError
from ctm_plugin.loggers.base import RunLogger
from ctm_plugin.runs.assemble import color_transform, load_scene
from ctm_plugin.settings import registry
from ctm_plugin.settings.listing import choices
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


THEIRS = """
from dataclasses import dataclass

from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.data.load import Layout
from ctm_plugin.data.settings import BoundsConfig
from ctm_plugin.settings.setting import Settings, setting


@dataclass(frozen=True)
class HalvedConfig(Settings, section="ctm"):
    times: int = setting(1, "how often", least=1)


class Halved(ColorTransform):
    "Half of each colour."

    Config = HalvedConfig


@dataclass(frozen=True, kw_only=True)
class Album(Layout, BoundsConfig):
    layout = "album"
    pages: int = setting(3, "pages", least=1)

    def load(self, capture=None):
        return self
"""


@pytest.fixture
def added(tmp_path, monkeypatch):
    """A transform and a data set, a file and a line of a table each; gone again afterwards."""
    (tmp_path / "in_one_file.py").write_text(THEIRS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(registry.TRANSFORMS.ours, "halved", "in_one_file:Halved")
    monkeypatch.setitem(registry.DATASETS.ours, "album", "in_one_file:Album")


def test_a_file_and_a_line_add_a_transform_and_a_data_set(added, tmp_path):
    data = ("dataset=album", f"dataset.root={tmp_path}", "dataset.geometry=bounded", "trainer=smoke")
    config = compose("ctm=halved", "ctm.times=2", *data)
    assert (config["ctm"]["preset"], config["ctm"]["times"], config["dataset"]["pages"]) == ("halved", 2, 3)
    transform = color_transform(config, 0)
    assert (type(transform).__name__, transform.config.times) == ("Halved", 2)
    assert load_scene(config).pages == 3
    assert choices(conf_dir(), "ctm")["halved"] == "Half of each colour"
    with pytest.raises(ConfigError, match=r"dataset\.pages: found 0, expected an integer >= 1"):
        load_scene(compose(*data, "dataset.pages=0"))


def test_what_was_removed_is_no_choice():
    with pytest.raises(ConfigError, match="ctm: found 'halved', expected one of auto, off, on, quick, release"):
        compose("ctm=halved")


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
