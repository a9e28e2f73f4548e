"""Look at runs in the browser."""

from __future__ import annotations

from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from ctm_plugin.color.light import factor_of
from ctm_plugin.errors import CTMError, held_interrupt
from ctm_plugin.settings.build import setting
from ctm_plugin.settings.check import check_integer


@dataclass(frozen=True, kw_only=True)
class ViewConfig:
    """Where to listen, and how to look."""

    port: int = setting(8080, "of the page")
    host: str = setting("127.0.0.1", "an address of this machine; 0.0.0.0 lets all who reach the machine look on")
    light: str = setting(
        "auto",
        "where the slider for the light of lifted pictures begins: auto gives dark scenes a normal mean, a number "
        "is so many stops, off 0",
    )

    def __post_init__(self) -> None:
        factor_of(self.light, 1.0)
        check_integer("port", self.port, 1)


def view(*runs: Path, settings: ViewConfig) -> None:
    """Serve runs to look at in the browser until Ctrl-C.

    Those of one scene can be switched between; a run still in training is shown as its last checkpoint has it.

    Raises:
        CTMError: viser is missing, or a run or the address cannot be used.
    """
    if find_spec("viser") is None:
        raise CTMError("viser: found no such package, expected it: pip install -e '.[view]'")
    from ctm_plugin.view.live_run import Subject
    from ctm_plugin.view.server import Viewer

    with suppress(KeyboardInterrupt), ExitStack() as stack:
        subjects = [Subject(run) for run in runs]
        with held_interrupt():  # half a server would go on listening, and the process with it
            viewer = stack.enter_context(closing(Viewer(subjects, settings.host, settings.port, settings.light)))
        viewer.work()
