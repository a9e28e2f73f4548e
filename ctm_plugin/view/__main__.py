"""``python -m ctm_plugin.view RUN_DIR [RUN_DIR ...] [port=8080] [host=127.0.0.1]``: look at runs in the browser.

Runs of one scene can be switched between; a run still in training is shown as its last checkpoint has it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import takewhile
from pathlib import Path

from ctm_plugin.check import check_integer
from ctm_plugin.config import build, pairs
from ctm_plugin.cpu.allocator import keep_memory
from ctm_plugin.errors import CTMError, held_interrupt


@dataclass(frozen=True, kw_only=True)
class ViewConfig:
    """Where to listen.

    Attributes:
        port: of the page.
        host: an address of this machine; ``0.0.0.0`` lets all who reach the machine look on.
    """

    port: int = 8080
    host: str = "127.0.0.1"

    def __post_init__(self) -> None:
        check_integer("port", self.port, 1)


def view(runs: Sequence[Path], config: ViewConfig) -> None:
    """Serve until Ctrl-C.

    Raises:
        CTMError: viser is missing, or a run or the address cannot be used.
    """
    if find_spec("viser") is None:
        raise CTMError("viser: found no such package, expected it: pip install -e '.[view]'")
    from ctm_plugin.view.server import Viewer
    from ctm_plugin.view.subject import Subject

    with suppress(KeyboardInterrupt), ExitStack() as stack:
        subjects = [Subject(run) for run in runs]
        with held_interrupt():  # half a server would go on listening, and the process with it
            viewer = stack.enter_context(closing(Viewer(subjects, config.host, config.port)))
        viewer.work()


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line: run directories and settings."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    runs = list(takewhile(lambda argument: "=" not in argument or Path(argument).is_dir(), arguments))
    if not runs or any(run.startswith("-") for run in runs):
        print(f"usage: {__doc__.split(': look')[0].strip('`')}", file=sys.stderr)
        return 2
    keep_memory()
    try:
        view([Path(run) for run in runs], build(ViewConfig, pairs(arguments[len(runs) :]), "view"))
    except CTMError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
