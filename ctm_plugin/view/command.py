"""The verb ``view``: a viewer of runs in the browser."""

from __future__ import annotations

from contextlib import ExitStack, closing, suppress
from importlib.util import find_spec
from pathlib import Path

from ctm_plugin.errors import CTMError, held_interrupt
from ctm_plugin.view.settings import ViewConfig


def view(*runs: Path, settings: ViewConfig) -> None:
    """Serve runs to look at in the browser until Ctrl-C.

    Those of one scene can be switched between; a run still in training is shown as its last checkpoint has it.
    Drag to turn, right-drag to shift, scroll to come nearer. A picture is coarse at first and gets finer while nothing
    moves. On forward-facing scenes, rays that do not go forward stay empty.

    - ``picture`` shows lit, dark, latent or depth, and sliders change the light, contrast and colour of lit pictures.
    - ``next to it`` adds another run, or the photograph where it was taken, under a slider or side by side.
    - ``view`` and ``cameras`` go to the place of a photograph.
    - ``crop box`` cuts away what lies outside a box along the world's axes.
    - ``camera path`` keeps key frames, tries them, and saves them with the light for ``ctm render RUN_DIR
      path=FILE.json``.

    Only this machine sees the page. On another one, ``ssh -L 8080:localhost:8080 MACHINE`` brings it.

    Raises:
        CTMError: viser is missing, or a run or the address cannot be used.
    """
    if find_spec("viser") is None:
        raise CTMError("viser: found no such package, expected version 1.1 or newer: pip install -e '.[view]'")
    from ctm_plugin.show.console import print_next
    from ctm_plugin.view.server import Viewer
    from ctm_plugin.view.sources import Subject

    with suppress(KeyboardInterrupt), ExitStack() as stack:
        subjects = [Subject(run, settings.dataset.root) for run in runs]
        with held_interrupt():  # half a server would go on listening, and the process with it
            viewer = stack.enter_context(closing(Viewer(subjects, settings)))
        print(f"look at {viewer.address} (Ctrl-C ends it)", flush=True)
        viewer.work()
    print_next("render", runs[0])
