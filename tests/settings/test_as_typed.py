"""Names are taken as they were typed; commas and Hydra's own words keep their meaning."""

from dataclasses import dataclass
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.compose.command_line import compose
from ctm_plugin.settings import registry
from ctm_plugin.settings.as_typed import HYDRA_VALUES, as_typed, bare

NAMES = (
    """20240501|2024_05_01|große Aufnahme|カメラ|cap (1)|a&b|a#b|it's|a=b|true|1e5|0x10|nan|[x]|{y}|x"y|a\\b|b\\| sp"""
)


@pytest.fixture(autouse=True)
def _empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def values(argument: str) -> list[str]:
    """What Hydra reads, one value or those of a sweep."""
    override = OverridesParser.create().parse_override(argument)
    found = override.value()
    return [str(getattr(each, "text", each)) for each in (found.list if override.is_sweep_override() else [found])]


@pytest.mark.parametrize("name", NAMES.split("|"))
@pytest.mark.parametrize("key", ["dataset.root", "+metrics.lpips_weights", "hydra.run.dir", "dataset.images"])
@pytest.mark.parametrize("sweep", [False, True])
def test_a_name_is_one_text(name, key, sweep):
    quoted = as_typed(f"{key}={name}", sweep)
    assert values(quoted) == [name]
    assert as_typed(quoted, sweep) == quoted


@given(
    st.text(min_size=1).filter(lambda text: "," not in text and "\n" not in text and not HYDRA_VALUES.fullmatch(text))
)
def test_any_text(text):
    assert values(as_typed(f"dataset.root={text}", False)) == [text]


def test_other_keys_are_hydras():
    for argument in ("seed=1,2", "ctm.lr=1e5", "backbone.grow=[1,2]", "dataset=colmap", "dataset.width=x (1)", "-m"):
        assert as_typed(argument, True) == argument


def test_what_hydra_would_read_as_the_same_text_stays():
    for argument in ("dataset.root=a/b.c", "dataset.root='a b'", "metrics.lpips_weights=null", "dataset.root=${x}/y"):
        assert as_typed(argument, False) == argument


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("a b", ["a b"]), ("'a b'", ["a b"]), ("'it\\'s'", ["it's"]), ("'a','b c'", ["a", "b c"]),
        ("choice('a,b',c)", ["a,b", "c"]), ("null", ["null"]), ("glob(*)", ["glob(*)"]),
    ],
)  # fmt: skip
def test_names_without_hydras_quotes(text, names):
    assert bare(text) == names
    Path(text).touch()
    assert bare(text) == [text]


def test_null_and_quotes_that_are_names():
    for name in ("null", "'q'", "choice(a,b)"):
        Path(name).mkdir()
        assert values(as_typed(f"dataset.root={name}", True)) == [name]


@pytest.mark.parametrize(
    ("there", "typed", "sweep", "expected"),
    [
        (["a", "b 1"], "a,b 1", True, ["a", "b 1"]),
        (["a", "b 1"], "a,b 1", False, ["a", "b 1"]),  # which is then refused: -m is missing
        (["a,b 1"], "a,b 1", False, ["a,b 1"]),
        (["a,b 1"], "a,b 1", True, ["a,b 1"]),
        (["a,b", "c"], "c,a,b", True, ["c", "a,b"]),
        ([], "a,b 1", True, ["a", "b 1"]),
        ([], "a,b 1", False, ["a,b 1"]),
        ([], "choice(a,b)", True, ["a", "b"]),
    ],
)
def test_commas(there, typed, sweep, expected):
    for name in there:
        Path(name).mkdir()
    assert values(as_typed(f"dataset.root={typed}", sweep)) == expected


def test_hydras_folders_are_not_swept():
    assert values(as_typed("hydra.sweep.dir=a,b", True)) == ["a,b"]


def test_keys_of_other_packages(monkeypatch):
    @dataclass(frozen=True, kw_only=True)
    class Theirs:
        folder: Path | None = None
        count: int = 1

    monkeypatch.setitem(registry.DATASETS.added, "theirs", Theirs)
    assert values(as_typed("dataset.folder=1e5", False)) == ["1e5"]
    assert as_typed("dataset.count=1_000", False) == "dataset.count=1_000"


def test_composed_in_python():
    for name in NAMES.split("|")[::6]:
        assert compose("dataset=colmap", f"dataset.root={name}")["dataset"]["root"] == name
