"""The verbs: help, one grammar for all, and every mistake as one message."""

import subprocess
import sys
from importlib.metadata import EntryPoints
from pathlib import Path

import pytest
from hydra.errors import HydraException

from ctm_plugin import cli
from ctm_plugin.errors import CTMError, Interrupted
from ctm_plugin.settings import registry
from ctm_plugin.settings.commands import TRAINING, VERBS, described, form
from ctm_plugin.settings.registry import load
from ctm_plugin.workflows import demo

BESIDE = sorted(VERBS.keys() - {"train"})
OF_RUNS = [name for name in BESIDE if VERBS[name].words.startswith("RUN")]


def settings(name: str) -> list[str]:
    """The keys of a verb."""
    return [key for key, *_ in described(load(VERBS[name].kind))]


def test_help_lists_all_verbs_then_what_people_choose_from(capsys):
    for arguments in (["--help"], ["train", "-h"], ["ctm=off", "--help"]):
        assert cli.main(arguments) == 0
        listed = capsys.readouterr().out.partition("for short.")[2]
        first = [line.split(" ")[0] for line in listed.splitlines()]
        places = [first.index(name) for name in (*VERBS, *(f"{group}=" for group in cli.MAIN_GROUPS))]
        assert places == sorted(places)


@pytest.mark.parametrize("name", BESIDE)
def test_help_of_a_verb(name, capsys):
    assert cli.main([name, "--help"]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    usage, *lines = captured.out.splitlines()
    assert usage.split() == ["usage:", *form(name, VERBS[name]).split()]
    assert form(name, VERBS[name]).startswith(f"ctm {name} {VERBS[name].words}".strip())
    shown = [line.split(" ")[0] for line in lines]
    assert [key for key in settings(name) if key not in shown] == []
    assert "``" not in captured.out


@pytest.mark.parametrize("name", BESIDE)
def test_an_unknown_key_is_told_with_the_known_ones(name, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    words = ["run"] * bool(VERBS[name].words)
    assert cli.main([name, *words, "speed=2"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    known = ["backbone", "seed"] if VERBS[name].others == TRAINING else sorted(settings(name))
    expected = error.partition("speed: found an unknown key, expected ")[2].partition(";")[0].replace(",", "").split()
    assert [key for key in known if key not in expected] == []
    assert expected or not known
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", OF_RUNS)
def test_a_run_that_is_not_there(name, capsys):
    assert cli.main([name, "nowhere"]) == 1
    assert capsys.readouterr().err.startswith("error: nowhere: found no such directory")


@pytest.mark.parametrize("name", [name for name in BESIDE if not VERBS[name].words.startswith("[")])
def test_words_that_are_missing_or_too_many(name, capsys):
    wanted = VERBS[name].words
    for words in ([], ["a", "b"])[not wanted : 1 if wanted.endswith("...") else 2]:
        assert cli.main([name, *words]) == 2
        found = " ".join(words) or "nothing"
        error, usage = capsys.readouterr().err.splitlines()
        assert error == f"error: found {found}, expected {wanted or 'only settings'}"
        assert usage.startswith(f"usage: ctm {name}")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("report runs --table 4", "found '--table', expected table=VALUE"),
        ("render run --fps=2", "found '--fps=2', expected fps=VALUE"),
        ("evaluate runs --table", "found '--table', expected key=value"),
        ("evaluat runs", "unknown command 'evaluat'; known: cameras, demo, "),
        (
            "x runs",
            "unknown command 'x'; known: cameras, demo, evaluate, export, list, photos, render, report, "
            "resume, scenes, train, view\n",
        ),
    ],
)
def test_what_was_a_flag_is_told_as_a_key(arguments, expected, capsys):
    assert cli.main(arguments.split()) == 2
    assert capsys.readouterr().err.startswith(f"error: {expected}")


@pytest.mark.parametrize(
    "arguments", [["render", "run", "fps=1", "fps=2"], ["render", "run", "fps="], ["view", "run", "=1"]]
)
def test_settings_that_cannot_be_read(arguments, refused):
    assert arguments[-1] in refused(*arguments)


def test_training_with_its_word(capsys):
    shown = []
    for word in ([], ["train"]):
        assert cli.main([*word, "--cfg", "job", "+ctm=off"]) == 0
        shown.append(capsys.readouterr().out)
    assert shown[0] == shown[1]
    assert "preset: 'off'" in shown[0]


@pytest.mark.parametrize("name", ["cameras", "report"])
@pytest.mark.parametrize(
    ("error", "code", "told"),
    [
        (CTMError("what"), 1, "error: what\n"),
        (OSError(28, "No space left", "file"), 1, "error: file: found no room on the disk (No space left), expected "),
        (HydraException("what"), 1, "error: what\n"),
        (KeyboardInterrupt(), 130, "stopped"),
        (Interrupted("after step 3", Path("run")), 130, "stopped after step 3; go on with: "),
        (Interrupted("after step 3", Path("run"), 15), 75, "stopped after step 3; go on with: "),
    ],
)  # fmt: skip
def test_how_every_verb_ends(name, error, code, told, monkeypatch, capsys):
    def ends(*words: Path, **given: object) -> None:
        raise error

    own = load
    monkeypatch.setattr(
        "ctm_plugin.settings.commands.load", lambda entry: ends if entry == VERBS[name].entry else own(entry)
    )
    assert cli.main([name, *["run"] * bool(VERBS[name].words)]) == code
    said = capsys.readouterr().err
    assert said.startswith(told)
    assert said.endswith(f"; go on with: ctm {name} run\n") == (VERBS[name].goes_on and code != 1)


def test_the_demo_tells_a_bad_key_before_it_trains(monkeypatch, capsys):
    monkeypatch.setattr(demo, "train", None)
    assert cli.main(["demo", "ctm.pretrain_steps=100"]) == 1
    told = "ctm.pretrain_steps: found an unknown key, expected one of name, preset"
    assert capsys.readouterr().err == f"error: {told}\n"


def test_verbs_are_listed_without_torch():
    code = "import sys, ctm_plugin.cli; sys.exit(bool({'torch', 'lightning', 'numpy'} & sys.modules.keys()))"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_a_verb_of_another_package(installed, capsys):
    """It is like one of ours, and nothing but its settings is imported before it begins."""
    assert cli.main(["--help"]) == 0
    assert ["greet", "greet", "somebody"] in map(str.split, capsys.readouterr().out.splitlines())
    assert cli.main(["greet", "--help"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("usage: ctm greet NAME [key=value ...]\n\nPrint a greeting.\n")
    assert ["times", "1", "how", "often"] in map(str.split, shown.splitlines())
    assert cli.main(["greet", "you", "time=2"]) == 1
    assert "error: time: found an unknown key, expected one of times; did you mean times?" in _error(capsys)
    assert cli.main(["greet", "you", "times=0"]) == 1
    assert "greet.times: found 0, expected an integer >= 1" in _error(capsys)
    assert cli.main(["greet"]) == 2
    assert "found nothing, expected NAME" in _error(capsys)
    assert cli.main(["greet", "you", "times=2"]) == 0
    assert capsys.readouterr().out == "hello you\n" * 2


def _error(capsys) -> str:
    return capsys.readouterr().err


def test_a_verb_that_cannot_be_imported(tmp_path, monkeypatch, capsys):
    """The others are listed still."""
    (tmp_path / "broken-1.dist-info").mkdir()
    (tmp_path / "broken-1.dist-info" / "METADATA").write_text("Name: broken\nVersion: 1\n")
    (tmp_path / "broken-1.dist-info" / "entry_points.txt").write_text("[ctm_plugin.verbs]\nbreak = nowhere:VERB\n")
    monkeypatch.syspath_prepend(tmp_path)
    why = "command 'break' (nowhere:VERB) cannot be imported: ModuleNotFoundError(\"No module named 'nowhere'\")"
    assert cli.main(["break", "x"]) == 1
    assert capsys.readouterr().err == f"error: {why}\n"
    assert cli.main(["--help"]) == 0
    listed = " ".join(capsys.readouterr().out.split())
    assert f"break {why}" in listed
    assert "cameras find the cameras" in listed


def test_a_verb_of_an_example_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setattr(registry, "entry_points", lambda group: EntryPoints())  # whatever is installed here
    where = "ctm scenes is in a package of its own: pip install -e docs/examples/ctm_scenes"
    for arguments in (["a.blend", "out=x"], ["--help"]):
        assert cli.main(["scenes", *arguments]) == 1
        assert capsys.readouterr().err == f"error: {where}\n"
    assert cli.main(["--help"]) == 0
    assert f"scenes {where}" in " ".join(capsys.readouterr().out.split())
