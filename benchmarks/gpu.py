"""What a GPU has to show, in so many minutes: ``CTM_DATA=FOLDER python benchmarks/gpu.py minutes=9 out=gpu``.

Steps and pictures at the paper's size, a training on splats, kernels and whole steps against plain torch, tests, and
with what time is left the paper's dark chair; ``parts=dvgo_on,chair`` does only these, with these names. All say what
they find in ``gpu.log``; a part that fails or takes too long stops no other.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

# Processes are forked from this one, which has imported everything: it must not wake the driver, as CUDA does not
# survive a fork, so that torch has to count GPUs without it. Nobody waits for a download of LPIPS' weights.
os.environ |= {"PYTORCH_NVML_BASED_CUDA_CHECK": "1", "CTM_TEST_GPU": "1", "https_proxy": "http://127.0.0.1:9"}

import kernels
import paper_scale
import pytest
import torch
from rich.console import Console
from step import measure, step_table

from ctm_plugin import cli
from ctm_plugin.errors import ConfigError, CTMError
from ctm_plugin.settings.build import build, pairs
from ctm_plugin.settings.setting import REQUIRED, Settings, setting

DATA = Path(os.environ.get("CTM_DATA", ""))
CHAIR = f"dataset.root={DATA / 'chair_800'}", "dataset.exposure=0.05"
TRAINS = "dataset.background=random_matched"
"""On backgrounds of any brightness dark plain RGB turns black, and its steps have nothing to do."""


def step(backbone: str, warm_up: int | None, *overrides: str, out: Path, name: str, steps: int = 40) -> None:
    """Time steps and views as ``step.py`` does, in this process."""
    found = measure(backbone, [*CHAIR, *overrides], steps, warm_up)
    Console(width=100).print(step_table(found))
    (out / f"{name}.json").write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


def splats(**_: object) -> None:
    """Train on photographs of a fern, whose pictures nobody wants."""
    with tempfile.TemporaryDirectory() as run:
        fern = "dataset=llff", f"dataset.root={DATA / 'fern'}", "dataset.downscale=8"
        sys.exit(cli.main([*fern, "backbone=splat", "trainer=quick", f"hydra.run.dir={run}"]))


def compared(**_: object) -> None:
    """Time kernels, and steps with them, against plain torch."""
    kernels.main()


def agree(**_: object) -> None:
    """Test kernels, gradients and waits."""
    chosen = "kernels or gradients or waits"  # types are checked only of what is not imported yet
    sys.exit(pytest.main(["-q", "-o", "addopts=", "tests/test_gpu.py", "-k", chosen]))


def chair(minutes: float, *, out: Path, **_: object) -> None:
    """Train on the paper's dark chair without a transform, with a quick one and with the paper's, all at once."""
    given = f"minutes={minutes:.1f}", f"out={out / 'chair.csv'}", "scenes=chair_800", "ctm=off,quick,on", "at_once=3"
    paper_scale.main([*given, TRAINS, CHAIR[1]])


DVGO = partial(step, "dvgo", 1500, "+experiment=synthetic_nerf_dark_dvgo", "trainer=paper", "backbone.grow=[]", TRAINS)
"""At the size that the paper's grid has grown to."""
NERF = "+experiment=synthetic_nerf_dark_nerf", "trainer=paper", "trainer.precision=auto"
PARTS: dict[str, tuple[float, Callable[..., None]]] = {
    "dvgo_on": (2, partial(DVGO, "ctm=on")),
    "dvgo_auto": (2, partial(DVGO, "ctm=auto")),
    "ngp_on": (2, partial(step, "ngp", 600, "trainer=standard", "trainer.precision=auto", "dataset=blender", "ctm=on")),
    "nerf_on": (2, partial(step, "nerf", None, *NERF, "ctm=on")),
    "splats": (2, splats),
    "kernels": (2, compared),
    "agree": (3, agree),
}
"""The most minutes of each part, and what it does."""
LAST = "chair"
"""It takes what time is left."""
LEAST = 2
"""Minutes that the chair is worth beginning with."""


@dataclass(frozen=True, kw_only=True)
class GpuConfig(Settings):
    """What, for how long, and where to."""

    minutes: float = setting(REQUIRED, "minutes for everything", above=0)
    out: str = setting(REQUIRED, "folder of the log and figures")
    parts: str = setting(",".join([*PARTS, LAST]), "what to do, comma-separated")


def processes() -> multiprocessing.context.BaseContext:
    """Forked from this one; fresh ones, if an import has woken the driver all the same."""
    fork = multiprocessing.get_context("fork")
    probe = fork.Process(target=lambda: sys.exit(torch.cuda._is_in_bad_fork()))
    probe.start()
    probe.join()
    return multiprocessing.get_context("spawn") if probe.exitcode else fork


def begin(work: Callable[[], None], log: Path) -> None:
    """In a process group of its own, whose every word goes to the log."""
    os.setsid()
    with log.open("a", encoding="utf-8") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    work()


def run(name: str, work: Callable[[], None], seconds: float, log: Path) -> str:
    """Do a part in a process of its own; say how it ended."""
    start = time.monotonic()
    process = processes().Process(target=begin, args=(work, log))
    process.start()
    process.join(seconds)
    ended = f"exit status {process.exitcode}"
    if process.is_alive():
        os.killpg(process.pid, signal.SIGKILL)  # and the processes that it has begun
        process.join()
        ended = "stopped"
    return f"{name}: {ended} after {time.monotonic() - start:.0f} s"


def main(arguments: Sequence[str]) -> None:
    """Do the parts one after the other."""
    settings = build(GpuConfig, pairs(arguments), "gpu")
    end, out, wanted = time.monotonic() + 60 * settings.minutes, Path(settings.out), settings.parts.split(",")
    if unknown := set(wanted) - {*PARTS, LAST}:
        raise ConfigError("gpu.parts", ",".join(sorted(unknown)), f"some of {', '.join([*PARTS, LAST])}")
    out.mkdir(parents=True, exist_ok=True)
    log = out / "gpu.log"
    for name, (minutes, work) in PARTS.items():
        left = end - time.monotonic()
        if name in wanted and left > 0:
            print(run(name, partial(work, out=out, name=name), min(left, 60 * minutes), log), flush=True)
    if LAST in wanted and (left := (end - time.monotonic()) / 60) > LEAST:
        print(run(LAST, partial(chair, left, out=out), 60 * left + 60, log), flush=True)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except CTMError as error:
        sys.exit(f"error: {error}")
