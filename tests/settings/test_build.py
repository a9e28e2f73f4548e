"""Typed settings from mappings: what is taken, and how each mistake is told."""

from dataclasses import FrozenInstanceError, dataclass, field

import pytest
from omegaconf import OmegaConf

from ctm_plugin.errors import ConfigError
from ctm_plugin.settings.build import build, unknown_key
from ctm_plugin.settings.setting import REQUIRED, by_geometry, defaults, meanings, setting


@dataclass(frozen=True, kw_only=True)
class Inner:
    low: float = 0.0
    high: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Middle:
    inner: Inner = field(default_factory=Inner)
    name: str = "m"


@dataclass(frozen=True, kw_only=True)
class Settings:
    root: str
    count: int = 3
    rate: float = 0.5
    flag: bool = False
    either: bool | str = "auto"
    limit: int | None = None
    steps: tuple[int, ...] = (1, 2)
    betas: tuple[float, float] = (0.9, 0.99)
    middle: Middle = field(default_factory=Middle)

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ConfigError("thing.count", self.count, "an integer >= 0")


@dataclass(frozen=True, kw_only=True)
class Base:
    size: int = by_geometry(3, 5, "in metres")
    seed: int = setting(0, "of it", composed="${seed}")
    inner: Inner = setting(Inner(), "bounds")
    plain: int = 1


@dataclass(frozen=True, kw_only=True)
class Derived(Base):
    root: str = setting(REQUIRED, "a folder")
    size: int = 4
    seed: int = setting(Base.seed, "of another")


def test_settings_say_what_they_mean_and_what_a_command_line_has():
    assert Base() == Base(size=3, seed=0, inner=Inner(), plain=1)
    inner = {"inner": {"low": 0.0, "high": 1.0}}
    assert defaults(Base) == {"size": "${by_geometry:3,5}", "seed": "${seed}", **inner, "plain": 1}
    assert next(iter(defaults(Derived).items())) == ("root", "???")
    assert defaults(Derived) == {"root": "???", "size": 4, "seed": 0, **inner, "plain": 1}
    assert meanings(Derived) == {
        "size": "in metres", "seed": "of another", "inner.low": "bounds", "inner.high": "bounds", "plain": "",
        "root": "a folder",
    }  # fmt: skip


def test_values_by_budget():
    text = "${by_budget:${by_geometry:1,2},[3,4]}"
    for budget, expected in {"quick": 2, "auto": 2, "standard": [3, 4]}.items():
        node = OmegaConf.create({"trainer": {"budget": budget}, "a": {"geometry": "forward", "b": text}})
        assert node.a.b == expected


def test_values_by_geometry():
    found = {}
    for geometry in (None, "bounded", "forward", "unbounded"):
        node = OmegaConf.create({"geometry": geometry, "two": "${by_geometry:1,2}", "three": "${by_geometry:1,2,3}"})
        found[geometry] = node.two, node.three
    assert found == {None: (1, 1), "bounded": (1, 1), "forward": (2, 2), "unbounded": (2, 3)}


def make(**values) -> Settings:
    return build(Settings, {"root": "here"} | values, "thing")


def test_defaults():
    assert make() == Settings(root="here")


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"count": 7}, {"count": 7}),
        ({"rate": 2}, {"rate": 2.0}),
        ({"rate": "1e-3"}, {"rate": 0.001}),
        ({"flag": True}, {"flag": True}),
        ({"either": False}, {"either": False}),
        ({"either": "on"}, {"either": "on"}),
        ({"limit": 4}, {"limit": 4}),
        ({"limit": None}, {"limit": None}),
        ({"steps": [4, 5, 6]}, {"steps": (4, 5, 6)}),
        ({"steps": (4,)}, {"steps": (4,)}),
        ({"steps": []}, {"steps": ()}),
        ({"betas": [0.5, 1]}, {"betas": (0.5, 1.0)}),
        ({"middle": {}}, {"middle": Middle()}),
        ({"middle": {"inner": {"low": 0.25}}}, {"middle": Middle(inner=Inner(low=0.25))}),
        ({"middle": {"name": "x"}}, {"middle": Middle(name="x")}),
    ],
    ids=lambda value: "-".join(value),
)
def test_values(given, expected):
    for values in (given, OmegaConf.create(given)):
        made = make(**values)
        assert made == Settings(root="here", **expected)
        for name, value in expected.items():
            assert type(getattr(made, name)) is type(value)


def test_result_is_frozen():
    with pytest.raises(FrozenInstanceError):
        make().count = 1
    with pytest.raises(FrozenInstanceError):
        make(middle={"inner": {"low": 0.5}}).middle.inner.low = 1


def test_defaults_are_not_shared():
    make(middle={"inner": {"low": 0.5}})
    assert make().middle.inner.low == 0.0


@pytest.mark.parametrize(
    ("values", "key", "found"),
    [
        ({"count": 2.5}, "count", "2.5"),
        ({"count": 2.0}, "count", "2.0"),
        ({"count": True}, "count", "True"),
        ({"count": "many"}, "count", "'many'"),
        ({"count": None}, "count", "None"),
        ({"count": [1]}, "count", "[1]"),
        ({"count": {"a": 1}}, "count", "{'a': 1}"),
        ({"rate": "fast"}, "rate", "'fast'"),
        ({"rate": False}, "rate", "False"),
        ({"flag": "perhaps"}, "flag", "'perhaps'"),
        ({"either": 3}, "either", "3"),
        ({"limit": "none"}, "limit", "'none'"),
        ({"steps": 5}, "steps", "5"),
        ({"steps": {"a": 1}}, "steps", "{'a': 1}"),
        ({"steps": [1, "b"]}, "steps[1]", "'b'"),
        ({"steps": [1, [2]]}, "steps[1]", "[2]"),
        ({"betas": [0.9, {"a": 1}]}, "betas[1]", "{'a': 1}"),
        ({"count": "${gone}"}, "count", "'${gone}'"),
        ({"middle": 3}, "middle", "3"),
        ({"middle": None}, "middle", "None"),
        ({"middle": {"inner": "x"}}, "middle.inner", "'x'"),
        ({"middle": {"inner": {"low": "x"}}}, "middle.inner.low", "'x'"),
    ],
    ids=lambda value: None if isinstance(value, dict) else value,
)
def test_wrong_types(values, key, found):
    with pytest.raises(ConfigError) as caught:
        make(**values)
    message = str(caught.value)
    assert message.startswith(f"thing.{key}: found {found}, expected ")
    assert "\n" not in message


@pytest.mark.parametrize("key", ["steps", "rate"])
def test_lists_in_lists_in_lists(key):
    nest: list = []
    for _ in range(5000):
        nest = [nest]
    with pytest.raises(ConfigError, match="thing: found lists or mappings nested too deeply, expected plain values"):
        make(**{key: nest})


@pytest.mark.parametrize(
    ("values", "key", "known"),
    [
        ({"nought": 1}, "nought", "betas, count, either, flag, limit, middle, rate, root, steps"),
        ({"middle": {"nom": 1}}, "middle.nom", "inner, name"),
        ({"middle": {"inner": {"mid": 1}}}, "middle.inner.mid", "high, low"),
    ],
    ids=["top", "nested", "deep"],
)
def test_unknown_keys_list_the_known(values, key, known):
    with pytest.raises(ConfigError) as caught:
        make(**values)
    assert str(caught.value) == f"thing.{key}: found an unknown key, expected one of {known}"


def test_the_key_that_was_meant_is_named():
    meant = {
        str(unknown_key("a.cuont", ["count", "rate"])),
        str(unknown_key("a.cuont", ["rate"], ["a.cuont", "b.count", "c.d.cuont", "e.cuont"])),
    }
    assert meant == {
        "a.cuont: found an unknown key, expected one of count, rate; did you mean a.count?",
        "a.cuont: found an unknown key, expected one of rate; did you mean c.d.cuont or e.cuont?",
    }


@pytest.mark.parametrize("values", [{}, {"root": "???"}])
def test_missing(values):
    with pytest.raises(ConfigError, match=r"^thing\.root: found nothing, expected a value$"):
        build(Settings, values, "thing")


def test_ranges_are_the_dataclass_s():
    with pytest.raises(ConfigError, match=r"^thing\.count: found -1, expected an integer >= 0$"):
        make(count=-1)
