"""The command line: ``python -m ctm_plugin [+]group=choice key=value ...``, ``VERB ...``, or ``ctm`` for short."""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
import warnings
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from hydra._internal.callbacks import Callbacks
from hydra._internal.hydra import Hydra
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.core.utils import run_job
from hydra.errors import HydraException
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

from ctm_plugin import __version__
from ctm_plugin.compose.choices import key_meanings, register, with_fitting_dataset
from ctm_plugin.compose.command_line import (
    GROUPS,
    at_work,
    check,
    check_values,
    composed,
    conf_dir,
    explain,
    prepared,
    searches_other_folders,
    warn_of_idle,
    without_hydras,
)
from ctm_plugin.cpu.threads import let_waiting_threads_sleep
from ctm_plugin.errors import ConfigError, CTMError, Interrupted
from ctm_plugin.settings import commands
from ctm_plugin.settings.as_typed import is_sweep
from ctm_plugin.settings.build import SECTIONS, unknown_key
from ctm_plugin.settings.listing import plain, print_choices, print_keys, print_names
from ctm_plugin.settings.registry import REGISTRIES, load
from ctm_plugin.settings.setting import keys

USER_ERRORS = (CTMError, HydraException, OmegaConfBaseException, OSError)
"""Errors that a user can mend; others are bugs, of ours or of another package's."""
REQUEUE_CODE = 75
"""Exit code after SIGTERM, on which clusters run a job again: ``EX_TEMPFAIL`` of sysexits.h."""

MAIN_GROUPS = ("dataset", "backbone", "ctm", "trainer")
"""Groups whose choices the help names; ``ctm list`` has all."""


def run(config: DictConfig) -> float | None:
    """Run one job, single or of a sweep; returns its PSNR, for sweepers that search, and raises what the job raises."""
    from ctm_plugin.compose.checks import checked
    from ctm_plugin.compose.decide import decide
    from ctm_plugin.cpu.allocator import give_back
    from ctm_plugin.files import is_main_process
    from ctm_plugin.runs.rundir import ERROR, LAST, new_folder
    from ctm_plugin.runs.sweep import go_on
    from ctm_plugin.runs.train import train
    from ctm_plugin.show.console import print_line, print_summary

    job = HydraConfig.get()
    folder = Path(job.runtime.output_dir)
    several = job.mode == RunMode.MULTIRUN
    going_on = config.sweep.resume
    if not several and is_main_process() and not any("hydra.run.dir=" in each for each in job.overrides.hydra):
        folder = new_folder(folder)
    (folder / ERROR).unlink(missing_ok=True)
    try:
        if going_on and not several:
            raise ConfigError("sweep.resume", going_on, "false without -m: a single run goes on by resume=RUN_DIR")
        capture = decide(config)
        settings = without_hydras(config)
        warn_of_idle(checked(settings, watched=False), job.overrides.task)
        if going_on:
            metrics = go_on(settings, Path(job.sweep.dir), folder, capture)
        else:
            metrics = train(settings, folder, print_line if several else print_summary, capture)
        return metrics.get("psnr")
    except Interrupted as stop:
        raise KeyboardInterrupt(str(stop)) from stop  # Hydra would go on with the next job of a sweep
    except Exception as error:
        if not several:
            raise
        text = f"error in job {job.job.num} ({' '.join(job.overrides.task)}): {explain(error)}"
        if not isinstance(error, USER_ERRORS):
            text += f"\n{traceback.format_exc()}"
        print(text, file=sys.stderr)
        with suppress(OSError):
            (folder / ERROR).write_text(f"{text}\n", encoding="utf-8")  # for reports on the sweep
        raise error.with_traceback(None) from None  # Hydra keeps it, and it the run in memory
    finally:
        give_back()
        for made in ((folder / LAST).parent, folder):
            with suppress(OSError):
                made.rmdir()  # stays if there is anything in it


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; every error of a user's is one message and a non-zero exit.

    Returns:
        The exit code: 0, 1 on an error, 2 where arguments cannot be read, 130 when interrupted, 75 (EX_TEMPFAIL: try
        again) when asked to end by SIGTERM.
    """
    let_waiting_threads_sleep()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with _a_line_each():
            _run(arguments)
    except (KeyboardInterrupt, Interrupted) as stop:
        from ctm_plugin.files import is_main_process

        if is_main_process():  # of several, one tells it
            print(str(stop) or "stopped", file=sys.stderr)
        cause = stop if isinstance(stop, Interrupted) else stop.__cause__
        return REQUEUE_CODE if isinstance(cause, Interrupted) and cause.by == signal.SIGTERM else 130
    except USER_ERRORS as error:
        print(f"error: {explain(error)}", file=sys.stderr)
        return 2 if isinstance(error, commands.UsageError) else 1
    return 0


def _run(arguments: list[str]) -> None:
    """Run the verb of a command line, or a training where there is none."""
    verb = "train"
    spaced = arguments[1:] and arguments[1].startswith("=")
    if arguments and arguments[0] and "=" not in arguments[0] and arguments[0][0] not in "-+~" and not spaced:
        verb, *arguments = arguments
    if verb != "train":
        commands.run(verb, arguments, check)
    elif {"-h", "--help"} & set(arguments):
        commands.print_verbs()
        print()
        print_names(Console(), conf_dir(), MAIN_GROUPS)
    elif {"-sc", "--shell-completion"} & set(arguments):
        _complete(arguments[1:])
    elif {"-V", "--version"} & set(arguments):
        print(f"ctm_plugin {__version__}")
    else:
        if arguments and os.path.isdir(arguments[0]):
            arguments[0] = f"dataset.root={arguments[0]}"
        commands.check_form(arguments)
        _train(arguments)


def print_list(*groups: Path, others: Sequence[str] = ()) -> None:
    """Print every choice of every group in a line each, or the keys of the groups given as GROUP or GROUP=CHOICE.

    GROUP=CHOICE also prints the choice's description. Raises a ConfigError for other names.
    """
    named = [*map(str, groups), *others]
    if not named:
        print_choices(Console(), conf_dir(), GROUPS)
        return
    chosen = [argument for argument in named if "=" in argument]
    ready = prepared(chosen)
    shown = dict.fromkeys(argument.lstrip("+").replace("=", ".").partition(".")[0] for argument in named)
    if unknown := [group for group in shown if group not in SECTIONS]:
        raise unknown_key(unknown[0], SECTIONS)
    with at_work():
        config = without_hydras(composed(ready))
    for group in shown:
        name = config[group].get("name", "")
        registry = REGISTRIES.get(group)
        if registry and name in registry.names() and any(each.lstrip("+").startswith(f"{group}=") for each in chosen):
            print(f"{plain(registry.docstring(name))}\n")
        print_keys(Console(), group, config[group], key_meanings(group, name))


def _complete(request: Sequence[str]) -> None:
    """Print what a shell asks for: a script for it, or how its line may go on, verbs and their keys included."""
    what, _, shell = " ".join(request).partition("=")
    if what not in ("install", "uninstall", "query") or shell not in commands.SHELLS:
        expected = f"install=SHELL or uninstall=SHELL, of {', '.join(commands.SHELLS)}"
        raise commands.UsageError(f"found {' '.join(request) or 'nothing'} after -sc, expected {expected}")
    if script := commands.SHELL_SCRIPTS.get(" ".join(request)):
        print(script)
        return
    if what == "query":
        program, *words, last = os.environ.get("COMP_LINE", "ctm ").split(" ")
        verb = commands.VERBS.get(words[0]) if words else None
        own = [f"{key}=" for key in keys(load(verb.kind))] if verb else [] if words else commands.names()
        print("\n".join(each for each in own if each.startswith(last)))
        if verb and verb.others != commands.TRAINING:
            return
        given = [each for each in words if "=" in each or each.startswith("-")]
        os.environ["COMP_LINE"] = " ".join([program, *given, last])  # Hydra reads overrides and its own flags
    register(None)
    with at_work(), suppress(HydraException):  # a line that cannot be composed yet has no more
        GlobalHydra.instance().hydra.shell_completion("config", list(request))


def _train(arguments: Sequence[str]) -> None:
    if any(_is_resume(argument) for argument in arguments):
        _resume(arguments)
        return
    given, arguments = arguments, with_fitting_dataset(arguments)
    if len(arguments) > len(given):
        print(f"{arguments[0]}, which reads that folder", file=sys.stderr)
    ready, parser = prepared(arguments), get_args_parser()
    parser.prog = "ctm"
    flags = parser.parse_intermixed_args(ready)
    name, overrides = flags.config_name or "config", [*flags.overrides]
    if (folder := flags.config_dir) is not None:
        if not os.path.isdir(folder):
            raise ConfigError("--config-dir", folder, "a folder with choices")
        url = QuotedString(f"file://{os.path.abspath(folder)}", Quote.single).with_quotes()
        overrides.append(f"hydra.searchpath=[{url}]")
    with at_work(flags.config_path):
        own = GlobalHydra.instance().hydra
        if flags.hydra_help:
            own.hydra_help(name, parser, flags)
        elif flags.info:
            own.show_info(flags.info, name, overrides)
        elif is_sweep(ready) and not flags.cfg:
            if not searches_other_folders(ready):
                check_values(composed(ready), ready)
            own.multirun(name, run, [*overrides, "hydra.mode=MULTIRUN"])
        else:
            config = composed(overrides, name, whole=True)
            check_values(config, ready)
            if flags.cfg:
                _print_one(own, config, flags)
            else:
                _run_one(own, config, name)


def _print_one(own: Hydra, config: DictConfig, flags: Namespace) -> None:
    """Print a configuration as Hydra's ``--cfg`` does, but with the values that the program decides."""
    from ctm_plugin.compose.decide import decide

    decide(config)
    HydraConfig.instance().set_config(config)
    OmegaConf.set_readonly(config.hydra, None)
    part = own.get_sanitized_cfg(config, flags.cfg)
    if package := flags.package:
        part = OmegaConf.select(part, package)
    if OmegaConf.is_config(part):
        print(f"# @package {package}\n" * bool(package) + OmegaConf.to_yaml(part, resolve=flags.resolve), end="")
    else:
        print(part)


def _run_one(own: Hydra, config: DictConfig, name: str) -> None:
    """Run a single job as Hydra does, but for its second composition, and its line before an error."""
    config.hydra.mode, failed = RunMode.RUN, []

    def job(settings: DictConfig) -> float | None:
        try:
            return run(settings)
        except Exception as error:
            failed.append(error)

    callbacks = Callbacks(config)
    callbacks.on_run_start(config=config, config_name=name)
    done = run_job(job, config, "hydra.run.dir", None, HydraContext(own.config_loader, callbacks))
    callbacks.on_run_end(config=config, config_name=name, job_return=done)
    if failed:
        raise failed[0]


def _is_resume(argument: str) -> bool:
    key, _, value = argument.partition("=")
    return key.lstrip("+") == "resume" and value != "null"


def _resume(arguments: Sequence[str]) -> None:
    places = [argument for argument in arguments if argument.startswith("dataset.root=")]
    runs = [argument.partition("=")[2] for argument in arguments if _is_resume(argument)]
    others = [argument for argument in arguments if argument not in places and not _is_resume(argument)]
    if others:
        expected = "nothing but dataset.root=: a run goes on with its own settings"
        raise CTMError(f"resume: found {' '.join(others)} with it, expected {expected}")
    if len(runs) > 1:
        raise CTMError(f"resume: found {len(runs)} runs, expected one")
    commands.run("resume", [f"./{runs[0]}" if "=" in runs[0] else runs[0], *places], check)


@contextmanager
def _a_line_each() -> Iterator[None]:
    """Context that prints each warning once, in a line without its place in the code, and no errors of threads."""
    lines: set[str] = set()
    shown, failed = warnings.formatwarning, threading.excepthook

    def unless_told_later(error: threading.ExceptHookArgs) -> None:
        if type(error.thread).__name__ != "_AsyncWriterThread":  # TensorBoard's: the next who writes gets the error
            failed(error)

    def once(message: Warning | str, *_: object, **__: object) -> str:
        line = f"warning: {message}\n"
        new = line not in lines  # a command reads its data more than once
        lines.add(line)
        return line * new

    warnings.formatwarning = once
    threading.excepthook = unless_told_later
    try:
        yield
    finally:
        warnings.formatwarning, threading.excepthook = shown, failed
