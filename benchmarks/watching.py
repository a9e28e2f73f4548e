"""The share of a run's wall clock that goes into what a person sees of it while it trains.

``python benchmarks/watching.py [+]group=choice key=value ...``, as on the command line of ``ctm_plugin``; the run lies
in a temporary folder. Every method with which Lightning calls the dashboard and the progress line is timed, and
the validations, whose pictures the dashboard shows.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import Counter
from functools import wraps
from pathlib import Path

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.callbacks.dashboard import Dashboard
from ctm_plugin.callbacks.progress import ProgressLine
from ctm_plugin.compose.command_line import compose
from ctm_plugin.runs.train import train


def timed(kind: type, spent: Counter[str], hooks: tuple[str, ...] = ("on_", "teardown")) -> None:
    """Count the seconds in all hooks of a callback, which begin with ``hooks``."""
    for name, method in vars(kind).copy().items():
        if name.startswith(hooks):

            @wraps(method)
            def hook(*args, method=method, **kwargs):
                start = time.perf_counter()
                try:
                    return method(*args, **kwargs)
                finally:
                    spent[kind.__name__] += time.perf_counter() - start

            setattr(kind, name, hook)


def main() -> None:
    spent: Counter[str] = Counter()
    for kind in (Dashboard, ProgressLine):
        timed(kind, spent)
    timed(Backbone, spent, ("validation_step",))
    config = compose(*sys.argv[1:])
    with tempfile.TemporaryDirectory() as folder:
        result = train(config, Path(folder) / "run")
    for name, seconds in spent.items():
        print(f"{name}: {seconds:.2f} s of {result['train_seconds']:.1f} s, {seconds / result['train_seconds']:.2%}")


if __name__ == "__main__":
    main()
