"""Every command of the pages that say what to type runs; long trainings up to the point where data would be read.

A sweep's jobs are thinned so that each of its choices is in one of them. Names in capitals stand for what a reader has:
``RUN_DIR`` and ``RUNS`` are runs of a few steps here, other paths are not read.
"""

import importlib.util
import io
import itertools
import re
import runpy
import shutil
import subprocess
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stderr
from dataclasses import fields
from pathlib import Path

import pytest
from ctm_plugin.settings.source import settings_of
from doc_commands import TYPED, Command, commands, spans
from hydra._internal.core_plugins.basic_launcher import BasicLauncher
from hydra.core.plugins import Plugins
from omegaconf import DictConfig, OmegaConf
from packaging.requirements import Requirement
from pages import PAGES, ROOT
from tensorboard.program import TensorBoard

import ctm_plugin.cameras.command as cameras
import ctm_plugin.scenes.command as scenes
import ctm_plugin.settings.commands as grammar
import ctm_plugin.view.command as view
from ctm_plugin import cli, demo, photos
from ctm_plugin.cpu import allocator
from ctm_plugin.runs import assemble, sweep, train
from ctm_plugin.runs.compose import GROUPS, compose, conf_dir
from ctm_plugin.scenes.settings import RenderSettings
from ctm_plugin.settings import listing, registry
from ctm_plugin.settings.build import build
from ctm_plugin.view.settings import ViewConfig
from ctm_plugin.view.sources import Subject

COMMANDS = [command for page in TYPED if page.is_file() for command in commands(page)]
SMOKE = (
    "trainer=smoke",
    "dataset.downscale=8",
    "dataset.skip=5",
    "backbone.coarse=false",
    "backbone.steps_alone=4",
    "backbone.grow=[2]",
)
OF_OTHERS = {
    **dict.fromkeys(
        ("ns-train", "ns-eval"),
        "nerfstudio wants other versions of what this package needs: make test-nerfstudio",
    ),
    "sbatch": "SLURM is no package of Python's: test_cluster.py runs the job script without it",
    "source": "it is the shell's own",
    "pipx": "it would install all of it anew, from the network",
}
"""Programs that these tests cannot run, and why."""
EXAMPLES = ("tiny_backbone", "ctm_controls")
"""Packages of the documentation that need nothing else."""
PACKERS = ("build", "twine")
"""Packages for a release."""
FILES = (".py", ".md", ".yaml", ".csv")
DRAWN = {path.name for path in (ROOT / "docs" / "pictures" / "concepts").glob("*.png")}
"""The pictures of the concepts that are there."""


# Runs to show


@pytest.fixture(scope="session")
def tiny_runs(once: Callable[..., Path]) -> Path:
    """A folder of runs of a few steps: the still life, dark and lit, and planar alignment; each colour."""
    return once("tiny_runs", train_tiny_runs)


def train_tiny_runs(folder: Path) -> None:
    still_life = ["dataset.downscale=8", "backbone.coarse=false", "backbone.steps_alone=20"]
    planar = ["backbone=barf2d", "dataset.height=32", "dataset.width=48", "dataset.patch=16", "backbone.steps=2"]
    kinds = {light: [*still_life, f"dataset.light={light}"] for light in ("dark", "lit")} | {"planar": planar}
    for kind, given in kinds.items():
        for ctm in (["ctm=off"], ["ctm=quick", "ctm.pretrain_steps=2"], ["ctm=auto"]):
            settings = compose("trainer=smoke", *given, *ctm)
            train.train(settings, folder / f"{kind}_{settings['ctm']['preset']}")


@pytest.fixture
def here(command: Command, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder with what a reader has: runs, where the command is about some."""
    monkeypatch.chdir(tmp_path)
    if re.search(r"RUN|\bruns\b|\blast\b", " ".join(command.words)):
        shutil.copytree(request.getfixturevalue("tiny_runs"), "RUNS")
        shutil.copytree("RUNS/dark_quick", "RUN_DIR")
        pages = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
        Path("path.json").write_text(re.search(r"^```json\n(.*?)^```", pages, re.DOTALL | re.MULTILINE)[1])
    return tmp_path


# What stands in for long trainings


class _Loading(Exception):
    """A run has come as far as its data."""


def _checked(config: dict, run: Path, tell: object = None) -> dict:
    """In place of a training: all settings are built, and what a sweeper searches by is given."""
    with pytest.raises(_Loading):
        assemble.assemble(config)
    return {"psnr": 1.0}


def _would_load(config: dict) -> None:
    build(registry.DATASETS.get(config["dataset"]["name"]), assemble._settings(config["dataset"]), "dataset")
    raise _Loading


def covering(jobs: list[list[str]]) -> list[list[str]]:
    """Few jobs of a sweep that have each choice of the others; a seed is like another."""
    left = {choice for job in jobs for choice in job if not choice.startswith("seed=")}
    chosen = jobs[:1]
    while left := left.difference(*chosen):
        chosen.append(max(jobs, key=lambda job: len(left.intersection(job))))
    return chosen


@contextmanager
def untrained() -> Iterator[None]:
    """Trainings are built and no more; a sweep's launcher is made, but Hydra's own runs its jobs."""
    instantiate = Plugins.instance().instantiate_launcher
    rows = importlib.import_module("hydra_plugins.ctm_rows.sweeper").RowsSweeper  # as Hydra has imported it by now
    jobs = rows.jobs

    def launcher(self: Plugins, **given: object) -> BasicLauncher:
        instantiate(**given)
        basic = BasicLauncher()
        basic.setup(**given)
        return basic

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CTM_DATA", "data")
        patch.setenv("CTM_SCENES", "scenes")
        patch.setattr(train, "train", _checked)
        patch.setattr(sweep, "train", _checked)
        patch.setattr(assemble, "load_scene", _would_load)
        patch.setattr(allocator, "give_back", lambda: None)  # collecting garbage after every job takes longer than it
        patch.setattr(rows, "jobs", lambda self, arguments: covering(jobs(self, arguments)))
        patch.setattr(rows, "validate_batch_is_legal", lambda self, batch: None)  # composes what the launcher will
        patch.setattr(Plugins, "instantiate_launcher", launcher)
        for name in EXAMPLES:
            add_package(patch, ROOT / "docs" / "examples" / name)
        yield


def offered(folder: Path) -> dict[str, dict[str, str]]:
    """The entry points of a package, by their groups."""
    return tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]


def add_package(patch: pytest.MonkeyPatch, folder: Path) -> None:
    """Register what a package offers, as if it were installed."""
    patch.syspath_prepend(folder)
    for each in registry.REGISTRIES.values():
        for name, entry in offered(folder).get(each.group, {}).items():
            patch.setitem(each.added, name, registry.load(entry))


# Rules, one for each kind of command


def command_line(words: Sequence[str]) -> None:
    """``ctm``: verbs have rules of their own, new trainings are built, all else runs."""
    if words and words[0] in VERBS:
        VERBS[words[0]](words)
        return
    fewer = ["hydra.sweeper.n_trials=2"] if "hydra/sweeper=search_weights" in words else []
    resuming = any(word.startswith("resume=") for word in words)
    with nullcontext() if resuming else untrained():
        assert cli.main([*words, *fewer]) == 0


def of_runs(words: Sequence[str]) -> None:
    """A command on runs that there are."""
    given = [re.sub("^last$", "RUN_DIR", re.sub(r"^runs(/.*)?$", "RUNS", word)).replace("=N", "=4") for word in words]
    keys = {word.partition("=")[0] for word in words}
    fewer = {
        "render": {"frames": "frames=2", "overwrite": "overwrite=true"},
        "export": {"cells": "cells=12", "opaque": "opaque=1e-9", "overwrite": "overwrite=true"},
    }.get(words[0], {})
    fewer = [word for key, word in fewer.items() if key not in keys]
    assert cli.main([*given, *fewer]) == (0 if words[1:] else 2)  # a sentence may only name it


def look(words: Sequence[str]) -> None:
    """``ctm view``: its runs are loaded, none is served."""
    seen = []

    def served(*runs: Path, settings: ViewConfig) -> None:
        seen.append([Subject(run) for run in runs])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(view, "view", served)
        assert cli.main([re.sub("^(RUN_.*|last)$", "RUN_DIR", word) for word in words]) == (0 if words[1:] else 2)
    assert len(seen) == bool(words[1:])


def demonstrate(words: Sequence[str]) -> None:
    """``ctm demo``: as it is, with fewer steps; what is given is built."""
    if words[1:]:
        _compose(words[1:])
        return

    def short(ctm: str, *others: str) -> dict:
        return compose(ctm, *others, *(["ctm.pretrain_steps=4"] if ctm == "ctm=quick" else []))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "compose", short)
        assert cli.main(["demo", *SMOKE]) == 0
    assert len(list(Path("runs").glob("demo_*/side_by_side.png"))) == 1


def draw_scenes(words: Sequence[str]) -> None:
    """``ctm scenes``: everything but Blender; files of presets are the reader's."""
    with pytest.MonkeyPatch.context() as patch, redirect_stderr(io.StringIO()) as said:
        patch.setattr(scenes, "render", lambda scene, out, settings: None)
        for name in scenes.EXAMPLES:  # test_packaging.py installs them
            patch.setitem(registry.SCENES.added, name, None)
        code = cli.main(list(words))
    assert (code, said.getvalue()) == (0, "") or "blends: found no " in said.getvalue()


def find_cameras(words: Sequence[str]) -> None:
    """``ctm cameras``: its settings are built, no cameras are looked for."""

    def nothing(folder: Path, settings: cameras.CamerasConfig) -> None:
        """Without COLMAP."""

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cameras, "cameras", nothing)
        assert cli.main(list(words)) == (0 if words[1:] else 2)  # a sentence may only name it


def from_photographs(words: Sequence[str]) -> None:
    """``ctm photos``: its settings are built, nothing is trained; ``test_photos.py`` does."""

    def nothing(folder: Path, settings: photos.PhotosConfig, others: Sequence[str] = ()) -> None:
        """Without photographs."""

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(photos, "photos", nothing)
        assert cli.main(list(words)) == (0 if words[1:] else 2)  # a sentence may only name it


def script(path: str, words: Sequence[str]) -> None:
    """A script of the checkout: those of pictures run; others are there and know their flags."""
    if path.startswith("docs/pictures/"):
        pictures = runpy.run_path(str(ROOT / path))
        if path.endswith("house.py"):
            pictures["main"](Path("house.svg"))
            assert Path("house.svg").read_bytes() == (ROOT / "docs/pictures/house.svg").read_bytes()
            return
        pictures["main"](Path("RUNS"), Path("pictures"))
        assert {picture.name for picture in Path("pictures").iterdir()} == DRAWN
        return
    source = (ROOT / path).read_text(encoding="utf-8")
    own = [word for word in words if word.startswith("--")]
    assert [flag for flag in own if f'"{flag}"' not in source] == []


def _compose(overrides: Sequence[str]) -> None:
    with untrained():
        _checked(compose(*overrides), Path())


def make(words: Sequence[str]) -> None:
    """What make would do."""
    done = subprocess.run(["make", "-n", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def pip(words: Sequence[str]) -> None:
    """``pip install``: the extras are there, files too, and versions are those of ``constraints.txt``."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    pinned = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    assert words[0] == "install"
    for flag, word in itertools.pairwise(words):
        if word.startswith("-"):
            assert word in ("-c", "-e")
        elif flag == "-c":
            assert (ROOT / word).is_file()
        elif "==" in word:
            assert word in pinned
        elif "/" in word:
            assert (ROOT / word / "pyproject.toml").is_file()
        else:
            wanted = Requirement(word.replace(".", project["name"], 1))
            if wanted.name in PACKERS:
                continue
            assert wanted.name.replace("_", "-") == project["name"]
            assert wanted.extras <= project["optional-dependencies"].keys()


def of_tests(words: Sequence[str]) -> None:
    """``pytest``: its files are there."""
    paths = [word for flag, word in itertools.pairwise(["", *words]) if not word.startswith("-") and flag != "-k"]
    assert [path for path in paths if not (ROOT / path).exists()] == []


def tensorboard(words: Sequence[str]) -> None:
    TensorBoard().configure(["tensorboard", *words])


VERBS: dict[str, Callable[[Sequence[str]], None]] = {
    "evaluate": of_runs,
    "resume": of_runs,
    "render": of_runs,
    "export": of_runs,
    "report": of_runs,
    "demo": demonstrate,
    "scenes": draw_scenes,
    "cameras": find_cameras,
    "photos": from_photographs,
    "view": look,
}
MODULES: dict[str, Callable[[Sequence[str]], None]] = {
    "ctm_plugin": command_line,
    "pytest": of_tests,
    "build": lambda words: None,  # test_release.py makes both packages
}
PROGRAMS: dict[str, Callable[[Sequence[str]], None]] = {
    "ctm": command_line,
    "make": make,
    "pip": pip,
    "tensorboard": tensorboard,
    "torchrun": lambda words: command_line(words[words.index("ctm_plugin") + 1 :]),
}


def rule(command: Command) -> tuple[Callable[[Sequence[str]], None], Sequence[str]]:
    """How a command is run, and what it is given."""
    program, *words = command.words
    program = program.removeprefix(".venv/bin/")
    if program != "python":
        assert program in PROGRAMS, f"no rule for {program}: add one to PROGRAMS, or a reason to OF_OTHERS"
        return PROGRAMS[program], words
    if words[0] != "-m":
        return lambda given: script(words[0], given), words[1:]
    assert words[1] in MODULES, f"no rule for python -m {words[1]}: add one to MODULES"
    return MODULES[words[1]], words[2:]


@pytest.mark.parametrize("command", {command.words: command for command in reversed(COMMANDS)}.values(), ids=str)
def test_command(command, here):
    if command.words[0] in OF_OTHERS:
        pytest.skip(OF_OTHERS[command.words[0]])
    run, words = rule(command)
    run(words)


def test_pages_with_commands_are_there():
    assert [page for page in TYPED if not page.is_file()] == []


def test_commands_are_found(tmp_path):
    """None is lost: in a block, over two lines, with a variable, with one set before, in a sentence."""
    page = tmp_path / "page.md"
    page.write_text(
        "Type `make demo`, or `ctm view \nlast`, in `runs`.\n\n```bash\n# a comment\n"
        "ctm -m seed=0,1 \\\n    'x=range(4)'  # two\n"
        "A=1 ctm dataset.root=$CTM_DATA/fern && ctm list\n```\n\n```python\nno = 1\n```\n"
    )
    assert [(command.line, command.words) for command in commands(page)] == [
        (6, ("ctm", "-m", "seed=0,1", "x=range(4)")),
        (8, ("ctm", "dataset.root=data/fern")),
        (1, ("make", "demo")),
        (1, ("ctm", "view", "last")),
    ]


def key_names(node: DictConfig, prefix: str = "") -> Iterator[str]:
    """Dotted names of keys and of mappings."""
    for name in node if isinstance(node, DictConfig) else ():
        yield f"{prefix}{name}"
        yield from key_names(node._get_node(name), f"{prefix}{name}.")


@pytest.fixture(scope="module")
def known(composed: Callable[..., dict]) -> dict[str, set[str]]:
    """Keys by group; under "" all of them, those beside the groups, and those of the other commands."""
    keys = {
        group: {
            name
            for choice in listing.choices(conf_dir(), group)
            for name in key_names(OmegaConf.create(composed(f"+{group}={choice}").get(group, {})))
        }
        for group in GROUPS
        if group != "experiment"  # of the others' keys
    }
    keys["experiment"] = set()
    beside = set(key_names(OmegaConf.load(conf_dir() / "config.yaml")))
    beside |= {f"metrics.{name}" for name, _ in listing.keys(composed()["metrics"])}
    others = {field.name for field in fields(RenderSettings)}
    others.update(key for verb in grammar.VERBS.values() for key in settings_of(f"ctm_plugin.{verb.entry}"))
    keys["color_space"].add("middle")  # of the example on plug_in.md
    return keys | {"": beside.union(others, *keys.values())}


@pytest.mark.parametrize("page", [page for page in PAGES if page.parent.name != "notes"], ids=lambda page: page.name)
def test_keys_and_choices_in_sentences(page, known):
    """What a sentence calls ``group=choice``, ``group.key`` or ``key=value`` is one."""
    wrong = []
    for line, span in spans(page):
        for word in span.split():
            key, equals, value = word.lstrip("+").partition("=")
            group, _, name = key.partition(".")
            if not re.fullmatch(r"[a-z_]+(\.[A-Za-z_]+)*", key) or not (equals or name) or key.endswith(FILES):
                continue
            if name == "NAME" or value in ("None", "True"):  # any key; Python
                continue
            if group not in GROUPS:
                fine = not equals or key in known[""] or group in ("hydra", "name")
            elif name:
                fine = name in known[group]
            else:
                fine = set(re.split("[,|]", value)) <= {
                    "yours",
                    "power",
                    *(
                        name
                        for each in EXAMPLES
                        for names in offered(ROOT / "docs/examples" / each).values()
                        for name in names
                    ),
                    *listing.choices(conf_dir(), group),
                }
            wrong += [] if fine else [f"line {line}: {word}"]
    assert wrong == []
