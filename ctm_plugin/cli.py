"""The command line: ``python -m ctm_plugin [+]group=choice key=value ...``, ``VERB ...``, or ``ctm`` for short."""

from __future__ import annotations

import os
import signal
import sys
import traceback
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

from ctm_plugin import commands
from ctm_plugin.config import GROUPS as PARTS
from ctm_plugin.config import unknown_key
from ctm_plugin.errors import ConfigError, CTMError, Interrupted, printable
from ctm_plugin.listing import print_choices, print_keys

REQUEUE = 75
"""Exit code after SIGTERM, with which clusters end a job to run it again: ``EX_TEMPFAIL`` of sysexits.h."""
GROUPS = ("dataset", "backbone", "ctm", "color_space", "loss", "trainer", "logger", "callbacks", "experiment")


def conf_dir() -> Path:
    """``conf/`` inside the package, where a wheel puts it, or beside it, in a checkout."""
    package = Path(__file__).resolve().parent
    inside, beside = package / "conf", package.parent / "conf"
    return inside if inside.is_dir() else beside


def normalise(arguments: Iterable[str]) -> list[str]:
    """Take the ``+`` off group choices: every group has a default, so that ``+backbone=dvgo`` would be a second choice.

    Only a single ``+`` before a group's own name goes: ``++x=1``, ``~group`` and ``+group.key=v`` pass.

    Example:
        >>> normalise(["+backbone=dvgo", "+backbone.width=3", "-m"])
        ['backbone=dvgo', '+backbone.width=3', '-m']
    """
    prefixes = tuple(f"+{group}=" for group in GROUPS)
    return [argument[1:] if argument.startswith(prefixes) else argument for argument in arguments]


def compose(*arguments: str) -> dict[str, Any]:
    """The configuration that a command line of group choices and keys comes to, resolved, for programs.

    :func:`explain` has the words for what Hydra raises.
    """
    from ctm_plugin.choices import register

    overrides = normalise(arguments)
    _check_choices(overrides)
    register()
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return resolved(hydra.compose("config", overrides))


def resolved(config: DictConfig) -> dict[str, Any]:
    """The configuration of one run as plain containers, without Hydra's own part and what is a sweep's."""
    settings = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    settings.pop("sweep", None)
    return settings


@hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="config")
def run(config: DictConfig) -> float | None:
    """One job, single or of a sweep; returns its PSNR, for sweepers that search."""
    from ctm_plugin.console import print_line, print_summary
    from ctm_plugin.cpu.allocator import give_back
    from ctm_plugin.rundir import ERROR
    from ctm_plugin.sweep import go_on
    from ctm_plugin.train import train

    job = HydraConfig.get()
    folder, settings = Path(job.runtime.output_dir), resolved(config)
    several = job.mode == RunMode.MULTIRUN
    going_on = config.sweep.resume
    (folder / ERROR).unlink(missing_ok=True)
    try:
        if going_on and not several:
            raise ConfigError("sweep.resume", going_on, "false without -m: a single run goes on by resume=RUN_DIR")
        if going_on:
            metrics = go_on(settings, Path(job.sweep.dir), folder)
        else:
            metrics = train(settings, folder, print_line if several else print_summary)
        return metrics.get("psnr")
    except Interrupted as stop:
        raise KeyboardInterrupt(str(stop)) from stop  # Hydra would go on with the next job of a sweep
    except Exception as error:
        if not several:
            raise
        told = f"error in job {job.job.num} ({' '.join(job.overrides.task)}): {error}"
        if not isinstance(error, (CTMError, HydraException, OmegaConfBaseException, OSError)):
            told += f"\n{traceback.format_exc()}"  # a bug of ours or of another package's
        print(told, file=sys.stderr)
        with suppress(OSError):
            (folder / ERROR).write_text(f"{told}\n", encoding="utf-8")  # for reports on the sweep
        raise error.with_traceback(None) from None  # Hydra keeps it, and it the run in memory
    finally:
        give_back()
        with suppress(OSError):
            folder.rmdir()  # made by Hydra; stays if there is anything in it


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; every error of a user's is one message and a non-zero exit.

    Returns:
        The exit code: 0, 1 on an error, 2 where arguments cannot be read, 130 when interrupted, 75 (EX_TEMPFAIL: try
        again) when asked to end by SIGTERM.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        _run(arguments)
    except (KeyboardInterrupt, Interrupted) as stop:
        return _stopped(stop)
    except (CTMError, HydraException, OmegaConfBaseException, OSError) as error:
        print(f"error: {explain(error)}", file=sys.stderr)
        return 2 if isinstance(error, commands.UsageError) else 1
    return 0


def _run(arguments: list[str]) -> None:
    """One verb; training where there is none."""
    verb = "train"
    if arguments and arguments[0] and "=" not in arguments[0] and arguments[0][0] not in "-+~":
        verb, *arguments = arguments
    if verb != "train":
        commands.run(verb, arguments)
    elif {"-h", "--help"} & set(arguments):
        commands.print_verbs()
        print()
        print_list()
    else:
        _train(normalise(arguments))


def print_list(*groups: Path, others: Sequence[str] = ()) -> None:
    """Every choice of every group, in a line each; the keys of groups that are named, as GROUP or GROUP=CHOICE."""
    named = [*map(str, groups), *others]
    if not named:
        print_choices(Console(), conf_dir(), GROUPS)
        return
    from ctm_plugin.choices import told

    config = compose(*(argument for argument in named if "=" in argument))
    for group in dict.fromkeys(argument.lstrip("+").replace("=", ".").partition(".")[0] for argument in named):
        if group not in PARTS:
            raise unknown_key(group, PARTS)
        print_keys(Console(), group, config[group], told(group, config[group].get("name", "")))


def _train(arguments: Sequence[str]) -> None:
    if any(_is_resume(argument) for argument in arguments):
        _resume(arguments)
    else:
        from ctm_plugin.choices import register

        _check_choices(arguments)
        register()
        with _hydras_arguments(arguments):
            run()


def _stopped(stop: BaseException) -> int:
    from ctm_plugin.distributed import is_main_process

    if is_main_process():  # of several, one tells it
        print(str(stop) or "stopped", file=sys.stderr)
    cause = stop if isinstance(stop, Interrupted) else stop.__cause__
    return REQUEUE if isinstance(cause, Interrupted) and cause.by == signal.SIGTERM else 130


def _is_resume(argument: str) -> bool:
    key, _, value = argument.partition("=")
    return key.lstrip("+") == "resume" and value != "null"


def _resume(arguments: Sequence[str]) -> None:
    from ctm_plugin.rundir import go_back
    from ctm_plugin.train import resume

    others = [argument for argument in arguments if not _is_resume(argument)]
    if others:
        raise CTMError(
            f"resume: found {' '.join(others)} beside it, expected nothing: a run goes on with its own settings"
        )
    if len(arguments) > 1:
        raise CTMError(f"resume: found {len(arguments)} runs, expected one")
    path = Path(arguments[0].partition("=")[2])
    resume(go_back(path) if path.suffix == ".ckpt" else path)


def _check_choices(arguments: Sequence[str]) -> None:
    """Refuse what cannot be read, and a group's choice that is no name: Hydra takes ``true`` for its own mistake."""
    parser = OverridesParser.create()
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals or argument.startswith("-"):
            continue
        try:
            given = parser.parse_override(argument)
        except HydraException as error:
            why = str(error).partition("\n")[0]
            raise ConfigError(key, value, f"a value that can be read ({why})") from error
        group = key.lstrip("+")
        if group in GROUPS and not given.is_sweep_override() and not (isinstance(given.value(), str) and value):
            raise ConfigError(group, value, "one of its choices")


@contextmanager
def _hydras_arguments(arguments: Sequence[str]) -> Iterator[None]:
    """Hydra reads ``sys.argv``, flags first, and tells its errors to us only if the environment says so."""
    argv, full = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv = ["ctm_plugin", *sorted(arguments, key=lambda argument: argument not in ("-m", "--multirun"))]
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        yield
    finally:
        sys.argv = argv
        del os.environ["HYDRA_FULL_ERROR"]
        if full is not None:
            os.environ["HYDRA_FULL_ERROR"] = full


def explain(error: Exception) -> str:
    """An error's message; of Hydra's with the known choices or keys where one is unknown."""
    if not isinstance(error, (HydraException, OmegaConfBaseException)):
        return str(error)
    if isinstance(error, MissingConfigException) and error.options and error.missing_cfg_file:
        group, _, name = error.missing_cfg_file.rpartition("/")
        return str(ConfigError(group, name, f"one of {', '.join(sorted(error.options))}"))
    cause = error.__cause__ or error
    full_key = getattr(cause, "full_key", None)
    parent = getattr(cause, "parent_node", None)
    if full_key and isinstance(parent, DictConfig) and "not in struct" in str(cause):
        return str(unknown_key(full_key, (str(key) for key in parent if key != "hydra")))
    return "\n".join(printable(line) for line in str(error).strip().splitlines())
