"""What a user can type: every choice, every verb, and every command of the pages that say what to type.

Nothing is trained: runs are composed and built up to where data would be read, verbs up to where they begin. A sweep's
jobs are thinned so that each of its choices is in one of them.
"""

import importlib
import itertools
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from functools import wraps
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import pytest
from ctm_scenes.settings import VERB
from hydra._internal.core_plugins.basic_launcher import BasicLauncher
from hydra.core.plugins import Plugins
from omegaconf import DictConfig, OmegaConf
from packaging.requirements import Requirement
from pages import PAGES, ROOT
from tensorboard.program import TensorBoard

from ctm_plugin import cli
from ctm_plugin.compose.command_line import GROUPS, compose, conf_dir
from ctm_plugin.cpu import allocator
from ctm_plugin.runs import assemble, rundir, sweep, train
from ctm_plugin.settings import listing, registry
from ctm_plugin.settings.commands import VERBS as OURS
from ctm_plugin.settings.commands import VERBS_OF_OTHERS
from ctm_plugin.settings.registry import load
from ctm_plugin.settings.setting import keys
from ctm_plugin.workflows import demo

GUIDES = ("index", "photographs", "refused", "colours", "concepts", "paper", "plug_in", "planar", "scenes", "cluster")
TYPED = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs" / f"{name}.md" for name in GUIDES)]
"""Pages whose commands are typed; those of others made the figures that they show."""
EXAMPLES = ("tiny_backbone", "ctm_controls", "ctm_scenes")
"""Packages of the documentation that say what they have without anything else."""
VERBS = OURS | {"scenes": VERB}
OF_OTHERS = ("ns-train", "ns-eval", "sbatch", "source", "eval")
"""Not ours: nerfstudio (``make test-nerfstudio``), SLURM's (``test_cluster.py``), the shell."""
FENCE = re.compile(r"^( *)```(\w*)\n(.*?)^\1```$", re.M | re.S)
INLINE = re.compile(r"(?:[A-Z_]+=\S+\s+)*(?:python|make|ctm|pip|tensorboard)\s+\S")
"""Commands inside a sentence."""


# The commands of a page


class Command(NamedTuple):
    """A command of a page: its words as a shell would give them, without variables and what follows on its failure."""

    page: Path
    line: int
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def commands(page: Path) -> Iterator[Command]:
    """All commands of a page: those in fenced blocks, then those inside sentences."""
    text = page.read_text(encoding="utf-8")
    for block in FENCE.finditer(text):
        whole = block[3].replace("\\\n", "\\\0")  # a command over several lines stands on the first
        if block[2] in ("", "bash", "sh"):
            for line in re.finditer(r"[^\n]+", whole):
                start = text[: block.start(3)].count("\n") + whole[: line.start()].count("\n") + 1
                if words := _words(line[0].replace("\\\0", " ")):
                    yield Command(page, start + whole[: line.start()].count("\0"), words)
    for line, span in spans(page):
        if INLINE.match(span):
            yield Command(page, line, _words(span))


def spans(page: Path) -> Iterator[tuple[int, str]]:
    """The code inside sentences, with its line."""
    text = FENCE.sub(lambda block: "\n" * block[0].count("\n"), page.read_text(encoding="utf-8"))
    for span in re.finditer(r"`([^`]+)`", text):
        yield text[: span.start()].count("\n") + 1, span[1]


def _words(text: str) -> tuple[str, ...]:
    lexer = shlex.shlex(text.replace("$CTM_DATA", "data"), posix=True, punctuation_chars="|&;")
    lexer.whitespace_split = True
    words = itertools.takewhile(lambda word: not set(word) <= set("|&;"), lexer)
    words = itertools.dropwhile(lambda word: re.fullmatch(r"[A-Z_]+=.*", word), words)
    return tuple(word.removesuffix("...") for word in words if word != "...")


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


# Runs that are not trained, verbs that do not begin


class _Loading(Exception):
    """A run has come as far as its data."""


def _built(config: dict, *_: object) -> dict:
    with pytest.raises(_Loading):
        assemble.assemble(config)
    return {"psnr": 1.0}


def _would_load(*_: object) -> None:
    raise _Loading


def covering(jobs: list[list[str]]) -> list[list[str]]:
    """Few jobs of a sweep that have each choice of the others; a seed is like another."""
    left = {choice for job in jobs for choice in job if not choice.startswith("seed=")}
    chosen = jobs[:1]
    while left := left.difference(*chosen):
        chosen.append(max(jobs, key=lambda job: len(left.intersection(job))))
    return chosen


def offered(folder: Path) -> dict[str, dict[str, str]]:
    """The entry points of a package, by their groups."""
    return tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """The verbs that would have begun; in an empty folder, with the packages of the documentation."""
    monkeypatch.chdir(tmp_path)
    for folder in ("capture", "FOLDER", "RUNS", "RUN_DIR", "runs/first", "runs/table4"):
        Path(folder).mkdir(parents=True)
    instantiate = Plugins.instance().instantiate_launcher
    rows = importlib.import_module("hydra_plugins.ctm_rows.sweeper").RowsSweeper  # as Hydra has imported it by now
    jobs, verbs = rows.jobs, []

    def launcher(self: Plugins, **given: object) -> BasicLauncher:
        instantiate(**given)
        basic = BasicLauncher()
        basic.setup(**given)
        return basic

    def stand_in(verb: str, function: Callable) -> Callable:
        @wraps(function)  # its annotations say what a verb is given
        def begin(*paths: Path, **given: object) -> None:
            verbs.append(verb)
            if verb in ("demo", "photos"):
                _built(compose(*VERBS[verb].usual, *given["others"]), Path())

        return begin

    for verb in VERBS.keys() - {"train", "list"}:
        for entry in filter(None, (VERBS[verb].entry, VERBS[verb].dry_run)):
            module, _, name = entry.partition(":")
            module = importlib.import_module(module)
            monkeypatch.setattr(module, name, stand_in(verb, getattr(module, name)))
    monkeypatch.setenv("CTM_DATA", "data")
    monkeypatch.setenv("CTM_SCENES", "scenes")
    monkeypatch.setattr(rundir, "runs_of", lambda path: [path])
    monkeypatch.setattr(train, "train", _built)
    monkeypatch.setattr(sweep, "train", _built)
    monkeypatch.setattr(assemble, "load_scene", _would_load)
    monkeypatch.setattr(allocator, "give_back", lambda: None)  # collecting garbage after every job takes longer than it
    monkeypatch.setattr(rows, "jobs", lambda self, arguments: covering(jobs(self, arguments)))
    monkeypatch.setattr(rows, "validate_batch_is_legal", lambda self, batch: None)  # composes what the launcher will
    monkeypatch.setattr(Plugins, "instantiate_launcher", launcher)
    for name in EXAMPLES:
        monkeypatch.syspath_prepend(ROOT / "docs" / "examples" / name)
        for each in (*registry.REGISTRIES.values(), VERBS_OF_OTHERS):
            for own, entry in offered(ROOT / "docs" / "examples" / name).get(each.group, {}).items():
                monkeypatch.setitem(each.added, own, load(entry))
    return verbs


# Every choice, every verb


CHOICES = [(group, choice) for group in GROUPS for choice in listing.choices(conf_dir(), group)]


@pytest.mark.slow
@pytest.mark.parametrize(("group", "choice"), CHOICES)
def test_choice(group, choice, begun, composed):
    """With a folder where it needs one; a table's rows are a sweep."""
    path = conf_dir() / group / f"{choice}.yaml"
    swept = group == "experiment" and "sweeper" in path.read_text(encoding="utf-8")
    root = not swept and composed(f"+{group}={choice}")["dataset"].get("root") == "???"
    assert cli.main([*["-m"] * swept, f"+{group}={choice}", *["dataset.root=FOLDER"] * root]) == 0


LINES = [
    "", "dataset=blender dataset.root=FOLDER", "train FOLDER dataset=blender", "-m seed=0,1 ctm=off,auto",
    "resume=RUN_DIR", "resume=RUN_DIR dataset.root=FOLDER", "resume RUN_DIR", "evaluate RUN_DIR light=off",
    "render RUN_DIR path=orbit", "export RUN_DIR what=mesh", "view RUN_DIR RUN_DIR", "report RUNS RUNS format=md",
    "list", "list backbone ctm=on", "demo backbone.coarse=false", "cameras FOLDER", "photos FOLDER ctm=off",
    "scenes a.blend out=b", "--help", "--version", "--cfg job ctm=off", "backbone.rays=9 ++seed=3 +loss=l1",
]  # fmt: skip
"""Each form that ``ctm --help`` and ``ctm VERB --help`` name."""


@pytest.mark.parametrize("line", LINES)
def test_line(line, begun):
    assert cli.main(line.split()) == 0
    verb = line.replace("=", " ").partition(" ")[0]
    assert begun == ([verb] if verb in VERBS and verb not in ("train", "list") else [])


def test_every_verb_has_a_line():
    assert VERBS.keys() <= {line.partition(" ")[0] for line in LINES}


@pytest.mark.slow
def test_demo(tmp_path, monkeypatch):
    """As it is, with fewer steps."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        demo, "compose", lambda *given: compose(*given, *["ctm.pretrain_steps=4"] * ("ctm=quick" in given))
    )
    small = "trainer=smoke dataset.downscale=8 dataset.skip=20 backbone.coarse=false backbone.steps_alone=4"
    assert cli.main(["demo", *small.split(), "backbone.grow=[2]"]) == 0
    (page,) = Path("runs").glob("demo_*/index.html")
    assert page.read_text(encoding="utf-8").count("stage compare") == 3


# Every command of the pages, by a rule for each program


def ctm(words: Sequence[str]) -> None:
    words = [word.replace("=N", "=4") for word in words]
    named_only = len(words) == 1 and VERBS.get(words[0]) is not None and words[0] not in ("list", "demo")
    assert cli.main(words) == (2 if named_only else 0)  # a sentence may only name it


def make(words: Sequence[str]) -> None:
    done = subprocess.run(["make", "-n", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def pip(words: Sequence[str]) -> None:
    """``pip install``: the extras are there, files too, and versions are those of ``constraints.txt``."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    pinned = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    assert words[0] == "install"
    for flag, word in itertools.pairwise(words):
        if word.startswith("-"):
            assert word in ("-c", "-e", "--no-deps")
        elif flag == "-c" or "/" in word:
            assert (ROOT / word).exists()
        elif "==" in word:
            assert word in pinned
        elif flag == "--no-deps":  # of packages that want others than they need
            assert any(line.startswith(f"{word}==") for line in pinned)
        elif word not in ("build", "twine"):
            wanted = Requirement(word.replace(".", project["name"], 1))
            assert wanted.name.replace("_", "-") == project["name"]
            assert wanted.extras <= project["optional-dependencies"].keys()


def python(words: Sequence[str]) -> None:
    """A module, or a script of the checkout, which is there, can be imported and knows its flags."""
    if words[0] != "-m":
        script = ROOT / words[0]
        with patch.object(sys, "path", [str(script.parent), *sys.path]):  # scripts import their neighbours
            runpy.run_path(str(script), run_name="looked_at")
        source = script.read_text(encoding="utf-8")
        assert [word for word in words[1:] if word.startswith("--") and f'"{word}"' not in source] == []
    elif words[1] == "pytest":
        paths = [word for flag, word in itertools.pairwise(words[1:]) if not word.startswith("-") and flag != "-k"]
        assert [path for path in paths if not (ROOT / path).exists()] == []
    elif words[1] != "build":  # test_release.py makes both packages
        assert words[1] == "ctm_plugin"
        ctm(words[2:])


PROGRAMS: dict[str, Callable[[Sequence[str]], object]] = {
    "ctm": ctm,
    "make": make,
    "pip": pip,
    "python": python,
    "tensorboard": lambda words: TensorBoard().configure(["tensorboard", *words]),
    "torchrun": lambda words: ctm(words[words.index("ctm_plugin") + 1 :]),
}
FIRST_PAGES = ("README.md", "photographs.md")
"""Pages whose commands are typed by each ``make test``."""
TYPED_COMMANDS = {command.words: command for page in reversed(TYPED) for command in commands(page)}


PAGE_COMMANDS = [each for words, each in TYPED_COMMANDS.items() if words[0] not in OF_OTHERS]


@pytest.mark.parametrize(
    "command",
    [pytest.param(each, marks=[pytest.mark.slow] * (each.page.name not in FIRST_PAGES)) for each in PAGE_COMMANDS],
    ids=str,
)
def test_command(command, begun):
    program, *words = command.words
    PROGRAMS[program.removeprefix(".venv/bin/")](words)


# Keys in sentences


def key_names(node: DictConfig, prefix: str = "") -> Iterator[str]:
    """Dotted names of keys and of mappings."""
    for name in node if isinstance(node, DictConfig) else ():
        yield f"{prefix}{name}"
        yield from key_names(node._get_node(name), f"{prefix}{name}.")


@pytest.fixture(scope="module")
def known(composed: Callable[..., dict]) -> dict[str, set[str]]:
    """Keys by group; under "" all of them, those beside the groups, and those of the verbs."""
    found = {group: set() for group in GROUPS}
    for group, choice in CHOICES:
        if group != "experiment":  # of the others' keys
            found[group].update(key_names(OmegaConf.create(composed(f"+{group}={choice}").get(group, {}))))
    found["color_space"].add("middle")  # of the example on plug_in.md
    beside = {*key_names(OmegaConf.load(conf_dir() / "config.yaml")), *keys(load(VERBS["scenes"].others))}
    beside.update(f"metrics.{name}" for name, _ in listing.keys(composed()["metrics"]))
    beside.update(key for verb in VERBS.values() for key in keys(load(verb.kind)))
    return found | {"": beside.union(*found.values())}


@pytest.mark.parametrize("page", [page for page in PAGES if page.parent.name != "notes"], ids=lambda page: page.name)
def test_keys_and_choices_in_sentences(page, known):
    """What a sentence calls ``group=choice``, ``group.key`` or ``key=value`` is one."""
    examples = [name for each in EXAMPLES for of in offered(ROOT / "docs/examples" / each).values() for name in of]
    wrong = []
    for line, span in spans(page):
        for word in span.split():
            key, equals, value = word.lstrip("+").partition("=")
            group, _, name = key.partition(".")
            is_key = re.fullmatch(r"[a-z_]+(\.[A-Za-z_]+)*", key) and (equals or name)
            is_file = key.endswith((".py", ".md", ".yaml", ".csv"))
            if not is_key or is_file or name == "NAME" or value in ("None", "True"):  # any key, Python
                continue
            if group not in GROUPS:
                fine = not equals or key in known[""] or group in ("hydra", "name")
            elif name:
                fine = name in known[group]
            else:
                fine = {*re.split("[,|]", value)} <= {"yours", "power", *examples, *listing.choices(conf_dir(), group)}
            wrong += [] if fine else [f"line {line}: {word}"]
    assert wrong == []
