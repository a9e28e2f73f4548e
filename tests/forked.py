"""Processes that begin with everything imported: each is forked from one that has, where a fresh one takes seconds."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from ctm_plugin import cli

PRELOAD = (
    "ctm_plugin.backbones.dvgo", "ctm_plugin.cli", "ctm_plugin.data.colmap", "ctm_plugin.data.planar",
    "ctm_plugin.data.rawnerf", "ctm_plugin.data.transforms", "ctm_plugin.export.video", "ctm_plugin.report.pairs",
    "ctm_plugin.report.page", "ctm_plugin.runs.train", "rawpy",
    *(["reordered"] if "CTM_REORDERED" in os.environ else []),
)  # fmt: skip
"""Modules that forked processes find imported: those of all tests, as one process of pytest has one server for them."""


def server(preload: Sequence[str] = PRELOAD) -> multiprocessing.context.ForkServerContext:
    """Starts processes that have imported everything."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(preload))
    return context


def _begin(
    main: Callable[[list[str]], int], arguments: list[str], told: Path, folder: Path, environment: dict[str, str]
) -> None:
    import torch

    os.environ |= environment
    os.chdir(folder)
    for stream, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(told / name, os.O_WRONLY | os.O_CREAT), stream)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a script ignore it
    torch.set_num_threads(1)
    sys.exit(main(arguments))


def execute(arguments: list[str]) -> int:
    """``python -c``."""
    exec(arguments[0], {})
    return 0


class Command:
    """``python -m ctm_plugin`` as a process, with what tests use of ``subprocess.Popen``.

    Args:
        arguments: of the command line.
        told: a new folder for what it says.
        folder: where it runs.
        main: what to run in place of the command line.
        environment: variables to set.
    """

    def __init__(
        self,
        *arguments: str,
        told: Path,
        folder: Path = Path(),
        main: Callable[[list[str]], int] = cli.main,
        **environment: str,
    ):
        told.mkdir(parents=True)
        self.told = told
        given = (main, list(arguments), told.resolve(), folder.resolve(), environment)
        self.process = server().Process(target=_begin, args=given, daemon=True)
        self.process.start()

    @property
    def returncode(self) -> int | None:
        return self.process.exitcode

    poll = returncode.fget

    def send_signal(self, number: int) -> None:
        os.kill(self.process.pid, number)

    def said(self, stream: str = "out") -> str:
        """What it has said so far, of ``out`` or ``err``."""
        path = self.told / stream
        return path.read_text() if path.exists() else ""

    def communicate(self, timeout: float = 120) -> tuple[str, str]:
        """Wait until it ends: what it said to both streams."""
        self.process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired("ctm_plugin", timeout, self.said(), self.said("err"))
        return self.said(), self.said("err")
