"""What a GPU has to show, in so many minutes: ``CTM_DATA=FOLDER python benchmarks/gpu.py minutes=14 out=gpu``.

Tests of the kernels, the kernels against plain torch, steps at the paper's size with CTM and without, pictures, splats,
and with what time is left the paper's dark chair. Each part has a log in ``out``, and is stopped when the minutes are
over; a part that fails stops no other.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ctm_plugin.errors import CTMError
from ctm_plugin.settings.build import build, pairs
from ctm_plugin.settings.setting import REQUIRED, Settings, setting

PYTHON = sys.executable
STEP = f"{PYTHON} benchmarks/step.py steps=40 out={{out}}/{{name}}.json"
PAPER = "trainer=paper dataset.root={data}/chair_800 dataset.exposure=0.05"
DVGO = f"{STEP} backbones=dvgo +experiment=synthetic_nerf_dark_dvgo {PAPER} warm_up=1500"
PARTS = {
    "agree": (3, f"{PYTHON} -m pytest -q tests/test_gpu.py -k 'kernels or gradients or waits'"),
    "kernels": (1, f"{PYTHON} benchmarks/kernels.py"),
    "dvgo_on": (2, f"{DVGO} ctm=on"),
    "dvgo_auto": (2, f"{DVGO} ctm=auto"),
    "ngp_on": (2, f"{STEP} backbones=ngp trainer=standard trainer.precision=auto dataset=blender "
               "dataset.root={data}/chair_800 dataset.exposure=0.05 ctm=on warm_up=600"),
    "nerf_on": (2, f"{STEP} backbones=nerf +experiment=synthetic_nerf_dark_nerf {PAPER} trainer.precision=auto ctm=on"),
    "splats": (2, f"{PYTHON} -m ctm_plugin dataset=llff dataset.root={{data}}/fern backbone=splat trainer=quick "
               "hydra.run.dir={out}/splats"),
}  # fmt: skip
"""The most minutes of each part, and its command."""
LEAST = 2
"""Minutes that the paper's chair is worth beginning with."""
CHAIR = (
    f"{PYTHON} benchmarks/paper_scale.py minutes={{minutes:.1f}} at_once=2 scenes=chair_800 out={{out}}/chair.csv "
    "runs={out}/chair dataset.exposure=0.05"
)


@dataclass(frozen=True, kw_only=True)
class GpuConfig(Settings):
    """How long, and where to."""

    minutes: float = setting(REQUIRED, "minutes for everything", above=0)
    out: str = setting(REQUIRED, "folder of the logs and figures")


def run(name: str, command: str, seconds: float, out: Path) -> str:
    """Run a command with its log in ``out``; say how it ended."""
    start = time.monotonic()
    with (out / f"{name}.log").open("w", encoding="utf-8") as log:
        process = subprocess.Popen(
            command, shell=True, stdout=log, stderr=log, env=os.environ | {"CTM_TEST_GPU": "1"}, start_new_session=True
        )
        try:
            ended = f"exit status {process.wait(seconds)}"
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)  # and the processes that a benchmark has begun
            process.wait()
            ended = "stopped"
    return f"{name}: {ended} after {time.monotonic() - start:.0f} s, {out / name}.log"


def main(arguments: Sequence[str]) -> None:
    """Do the parts one after the other."""
    settings = build(GpuConfig, pairs(arguments), "gpu")
    end, out = time.monotonic() + 60 * settings.minutes, Path(settings.out)
    out.mkdir(parents=True, exist_ok=True)
    known = {"data": os.environ["CTM_DATA"], "out": out}
    for name, (minutes, command) in PARTS.items():
        left = end - time.monotonic()
        if left > 0:
            print(run(name, command.format(name=name, **known), min(left, 60 * minutes), out), flush=True)
    if (left := (end - time.monotonic()) / 60) > LEAST:
        print(run("chair", CHAIR.format(minutes=left, **known), 60 * left + 60, out), flush=True)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except CTMError as error:
        sys.exit(f"error: {error}")
