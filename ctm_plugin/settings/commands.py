"""The verbs of the command line, and the one grammar of all but training: ``ctm VERB WORD ... key=value ...``."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple, get_type_hints

from omegaconf import OmegaConf
from rich.console import Console

from ctm_plugin.errors import CTMError, Interrupted, UnknownNameError, printable
from ctm_plugin.settings.build import asked, build, near_to, pairs, unknown_key
from ctm_plugin.settings.listing import leaves, plain, print_rows
from ctm_plugin.settings.registry import Registry, load, said_by
from ctm_plugin.settings.setting import defaults, keys, meanings

USAGE = """\
ctm [group=choice ...] [key=value ...]      one run
ctm -m group=a,b key=range(3) ...           all combinations; sweep.resume=true goes on with a sweep
ctm resume=RUN_DIR                          go on with a run; RUN_DIR may be last, the newest there is, everywhere
ctm --cfg job [group=choice ...]            every key that a command line comes to, without running it
ctm photos FOLDER --cfg job                 what that would do, without doing it
eval "$(ctm -sc install=bash)"              the tab key completes; also zsh, and in fish: ctm -sc install=fish | source
ctm VERB ...                                one of these; ctm VERB --help says more

ctm is python -m ctm_plugin for short.
"""
"""Usage of the command line."""
TRAINING = "training"
HYDRA_FLAGS = shlex.split("""-m --multirun -r --run -c --cfg -p --package --resolve -i --info -cd --config-dir -cp
    --config-path -cn --config-name --hydra-help""")
"""Hydra's own flags, which may have a value after them."""
BARE_FLAGS = shlex.split("-m --multirun -r --run -c --cfg -i --info")
"""Hydra's flags of which at most one may be given."""
DRY_RUN = "--cfg", "-c"
"""Hydra's flag for verbs with a dry run, with the value ``job``."""
SHELLS = "bash", "zsh", "fish"
"""Shells whose command lines are completed."""
SHELL_SCRIPTS = {
    "install=zsh": """\
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit }
_ctm() {
    compadd -S '' -- ${=$(COMP_LINE="${(j: :)words[1,CURRENT]}" $words[1] -sc query=zsh)}
    _files
}
compdef _ctm ctm""",
    "uninstall=zsh": "compdef -d ctm",
    "install=fish": "complete -c ctm -a '(COMP_LINE=(commandline -cp) ctm -sc query=fish)'",
    "uninstall=fish": "complete -c ctm -e",
}
"""Scripts in place of Hydra's: its script for zsh is bash's, which fails there; in fish it completes no paths."""


class UsageError(CTMError):
    """Arguments that a verb cannot read."""


class Verb(NamedTuple):
    """A verb of the command line: its form, its settings and its function.

    Attributes:
        summary: what the verb does, in a line.
        words: names of the words before its settings; ``...`` at the end: one or several; in brackets: or none.
        entry: ``module:function``, imported when it is asked for. The function is given the paths, checked
            ``settings``, if it has a parameter of that name, and what is left as ``others``.
        kind: ``module:dataclass`` of its settings.
        others: ``module:dataclass`` whose keys are accepted too, unchecked; ``TRAINING``: the keys of a run.
        usual: choices of the run unless ``others`` give them.
        goes_on: whether the same command, given again, resumes where it was stopped.
        dry_run: ``module:function`` for ``--cfg job``: prints what ``entry`` would do.
    """

    summary: str
    words: str = ""
    entry: str = ""
    kind: str = "ctm_plugin.settings.setting:Nothing"
    others: str = ""
    usual: tuple[str, ...] = ()
    goes_on: bool = False
    dry_run: str = ""


VERBS = {
    "photos": Verb(
        "make lit views and a film of photographs or clips", "FOLDER", "ctm_plugin.workflows.photos:photos",
        "ctm_plugin.workflows.settings:PhotosConfig", TRAINING, ("dataset=colmap", "dataset.root=."), True,
        "ctm_plugin.workflows.photos:dry_run",
    ),
    "train": Verb("train one run, or with -m a sweep; the word train may be left out"),
    "resume": Verb(
        "go on with a run, like resume=RUN_DIR", "RUN_DIR", "ctm_plugin.runs.train:command",
        "ctm_plugin.runs.settings:RunConfig",
    ),
    "evaluate": Verb(
        "score a run again, from its checkpoint", "RUN_DIR", "ctm_plugin.runs.evaluate:command",
        "ctm_plugin.runs.settings:LitConfig",
    ),
    "render": Verb(
        "render a lit film of a run", "RUN_DIR", "ctm_plugin.export.video:render",
        "ctm_plugin.export.settings:VideoConfig",
    ),
    "export": Verb(
        "write a run's splats, points, mesh or cameras for other programs", "RUN_DIR",
        "ctm_plugin.export.command:export", "ctm_plugin.export.settings:ExportConfig",
    ),
    "view": Verb(
        "look around in runs in the browser", "RUN_DIR ...", "ctm_plugin.view.command:view",
        "ctm_plugin.view.settings:ViewConfig",
    ),
    "report": Verb(
        "make tables of finished runs, with the paper's values", "RUNS ...",
        "ctm_plugin.report.command:report", "ctm_plugin.report.settings:ReportConfig",
    ),
    "list": Verb(
        "list the choices of all groups, or the keys of GROUP or GROUP=CHOICE", "[GROUP...]",
        "ctm_plugin.cli:print_list", others=TRAINING,
    ),
    "demo": Verb(
        "train the dark still life without CTM and with it, and compare", "", "ctm_plugin.workflows.demo:demo",
        others=TRAINING,
    ),
    "cameras": Verb(
        "find the cameras of photographs with COLMAP", "FOLDER", "ctm_plugin.cameras.command:cameras",
        "ctm_plugin.cameras.settings:CamerasConfig", goes_on=True,
    ),
}  # fmt: skip
VERBS_OF_OTHERS = Registry("command", "ctm_plugin.verbs", {})
EXAMPLE_VERBS = {"scenes": "docs/examples/ctm_scenes"}
"""Verbs of example packages, and the folder of each in a checkout."""


def names() -> list[str]:
    """List the names of all verbs: built in, of installed packages, and of examples that are not installed."""
    return [*VERBS, *sorted({*VERBS_OF_OTHERS.names(), *EXAMPLE_VERBS} - VERBS.keys())]


def verb_of(name: str) -> Verb:
    """Find a verb; another package's is imported.

    Raises:
        UsageError: there is none.
        CTMError: it cannot be imported, or is an example's that is not installed.
    """
    if name in VERBS:
        return VERBS[name]
    if name in VERBS_OF_OTHERS.names():
        return VERBS_OF_OTHERS.get(name)
    if name in EXAMPLE_VERBS:
        raise CTMError(f"ctm {name} is in a package of its own: pip install -e {EXAMPLE_VERBS[name]}")
    meant = near_to(name, names())
    if os.path.isdir(name):
        meant = [f"ctm {verb} {shlex.quote(name)}" for verb in ("photos", "train")]
    raise UsageError(f"{UnknownNameError('command', name, names())}{asked(meant)}")


def run(name: str, arguments: Sequence[str], check: Callable[[Sequence[str]], None]) -> None:
    """Run a verb other than ``train``, or print its help; what is mistyped is refused before the verb is imported.

    Args:
        name, arguments: the command line.
        check: raises an error for mistyped choices and keys of a run.

    Raises:
        UsageError: there is no such verb, words are missing or too many, or there are flags.
        CTMError: a key is unknown, a value cannot be used, or what the command says.
        KeyboardInterrupt: it was stopped; the message says how to go on.
    """
    verb = verb_of(name)
    try:
        _run(name, verb, arguments, check)
    except (KeyboardInterrupt, Interrupted) as stop:
        if not verb.goes_on:
            raise
        when = stop.when if isinstance(stop, Interrupted) else str(stop) or "stopped"
        raise KeyboardInterrupt(f"{when}; go on with: {shlex.join(['ctm', name, *arguments])}") from stop


def _run(name: str, verb: Verb, arguments: Sequence[str], check: Callable[[Sequence[str]], None]) -> None:
    kind = load(verb.kind)
    known = keys(kind)
    usage = f"usage: {form(name, verb)}"
    if {"-h", "--help"} & set(arguments):
        about, rows = explained(verb)
        print(f"{usage}\n\n{about}\n")
        print_rows(Console(), rows)
        if verb.others == TRAINING:
            print("All choices and keys of a run can be given too: see ctm --help.")
        return
    entry = verb.entry
    if verb.dry_run and (flag := next((each for each in DRY_RUN if each in arguments), None)):
        at, entry = arguments.index(flag), verb.dry_run
        if arguments[at + 1 : at + 2] != ["job"]:
            raise UsageError(f"found {shlex.join(arguments[at : at + 2])}, expected {flag} job\n{usage}")
        arguments = [*arguments[:at], *arguments[at + 2 :]]
    for flag in (argument for argument in arguments if argument.startswith("-")):
        key = flag.lstrip("-").partition("=")[0].replace("-", "_")
        types = {field.name: field.type for field in fields(kind)}
        wanted = f"{key}={'true' if types[key] == 'bool' else 'VALUE'}" if key in types else "key=value"
        raise UsageError(f"found {flag!r}, expected {wanted}\n{usage}")
    words = list(takewhile(lambda word: "=" not in word or (verb.words and os.path.exists(word)), arguments))
    rest = arguments[len(words) :]
    enough = verb.words.startswith("[") or (words and verb.words.endswith("..."))
    if len(words) != len(verb.words.split()) and not enough:
        path, expected = " ".join(words), verb.words or "only settings"
        quoted = asked([shlex.quote(path)] if len(words) > 1 and os.path.exists(path) else [])
        raise UsageError(f"found {printable(path) or 'nothing'}, expected {expected}{quoted}\n{usage}")
    others, mine = [], []
    for each in rest:
        key = each.partition("=")[0]
        (mine if not verb.others or key in known or near_to(key, known) else others).append(each)
    own = pairs(mine)
    if unknown := [key for key in own if key not in known]:
        raise unknown_key(unknown[0], known)
    node = OmegaConf.create()
    for key, value in own.items():
        OmegaConf.update(node, key, None if value == "null" else value)
    given = {"settings": build(kind, node, ""), "others": others}
    if verb.others == TRAINING and name != "list":
        named = {other.lstrip("+").partition("=")[0] for other in others}
        check([*(each for each in verb.usual if each.partition("=")[0] not in named), *others])
    paths = _runs(words, verb) if verb.words.startswith("RUN") else map(Path, words)
    function = load(entry)
    function(*paths, **{key: given[key] for key in get_type_hints(function) if key in given})


def form(name: str, verb: Verb) -> str:
    """Write a verb's command line: ``ctm VERB WORD ... [key=value ...]``."""
    has_keys = bool(verb.others or keys(load(verb.kind)))
    return " ".join(filter(None, ("ctm", name, verb.words, "[key=value ...]" * has_keys)))


def explained(verb: Verb, code: str = "") -> tuple[str, list[tuple[str, str, str]]]:
    """Read a verb's description (:func:`plain`), and the name, default and meaning of each of its settings."""
    rows = described(load(verb.kind)) + (described(load(verb.others)) if ":" in verb.others else [])
    return plain(said_by(verb.entry), code), rows


def check_form(arguments: Sequence[str]) -> None:
    """Refuse what is neither ``key=value`` nor one of Hydra's flags, and flags that it does not take together.

    Raises:
        UsageError: there are such arguments.
    """
    for before, argument, after in zip(["", *arguments], arguments, [*arguments[1:], ""], strict=False):
        key, equals, value = argument.partition("=")
        if argument.startswith("-"):
            if key not in HYDRA_FLAGS:
                raise UsageError(f"found {argument!r}, expected {key.lstrip('-')}={value or 'VALUE'}")
        elif after.startswith("=") or (argument.endswith("=") and after and "=" not in after):
            raise UsageError(f"found {f'{argument} {after}'!r}, expected key=value, without spaces round the =")
        elif not equals and not key.startswith("~") and before not in HYDRA_FLAGS:
            raise UsageError(f"found {argument!r}, expected key=value")
    if len(given := dict.fromkeys(flag for each in arguments if (flag := each.partition("=")[0]) in BARE_FLAGS)) > 1:
        raise UsageError(f"found {' with '.join(given)}, expected one of these")


def print_verbs() -> None:
    """Print the usage of the command line, and a line on each verb."""
    print(USAGE)
    print_rows(Console(), [(name, _summary(name)) for name in names()])


def _summary(name: str) -> str:
    try:
        return verb_of(name).summary
    except CTMError as error:
        return str(error)


def described(kind: type) -> list[tuple[str, str, str]]:
    """Tell name, default and meaning of each field of a dataclass."""
    values, words = dict(leaves(defaults(kind))), {"???": "needed", "None": ""}
    return [(key, words.get(str(values[key]), str(values[key]).lower()), text) for key, text in meanings(kind).items()]


def _runs(words: Sequence[str], verb: Verb) -> Iterator[Path]:
    """Find the runs that words name: of a folder of runs the newest, or all where a verb takes several.

    Reports search folders themselves, and name the runs that they leave out.
    """
    runs_of = load("ctm_plugin.runs.rundir:runs_of")

    for path in map(Path, words):
        runs = [path] if verb.words.startswith("RUNS") and path.is_dir() else runs_of(path)
        chosen = runs if verb.words.endswith("...") else runs[-1:]
        if chosen != [path]:
            print(f"{path}: {', '.join(map(str, chosen))}", file=sys.stderr)
        yield from chosen
