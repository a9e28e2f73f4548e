"""Kills runs at random moments and resumes them: ``python tests/faults.py [--kills 50]``.

The same as ``test_faults.py`` does a few times. Each run is killed by SIGKILL somewhere between its first moment and
its last, a checkpoint being written in every step, then resumed; it has to end bit for bit as one that nobody killed.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import random
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from forked import server

LAST, METRICS = "checkpoints/last.ckpt", "metrics.json"
TIMES = ("train_seconds", "rays_per_second", "peak_memory_mb")
ARGUMENTS = (
    "dataset=still_life", "dataset.downscale=8", "dataset.skip=10", "trainer=smoke", "trainer.checkpoint_every=1",
    "trainer.precision=32-true", "trainer.accelerator=cpu", "ctm.pretrain_steps=20", "backbone.coarse=true",
    "backbone.coarse_steps=6", "backbone.steps=14", "backbone.grow=[3,6]", "backbone.occupancy_first=2",
    "backbone.rays=64", "trainer.image_every=null",
)  # fmt: skip


def differing(a: Any, b: Any, key: str = "") -> Iterator[str]:
    """Where two nests of containers and tensors are not equal bit for bit."""
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        if a.dtype != b.dtype or not torch.equal(a, b):
            yield key
    elif isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys():
        for name in a:
            yield from differing(a[name], b[name], f"{key}/{name}")
    elif isinstance(a, (list, tuple)) and isinstance(b, (list, tuple)) and len(a) == len(b):
        for index, (x, y) in enumerate(zip(a, b, strict=True)):
            yield from differing(x, y, f"{key}/{index}")
    elif type(a) is not type(b) or a != b:
        yield key


def checkpoint(run: Path) -> dict[str, Any]:
    return torch.load(run / LAST, weights_only=True)


def scores(run: Path) -> dict[str, Any]:
    return {key: value for key, value in json.loads((run / METRICS).read_text()).items() if key not in TIMES}


def differences(run: Path, whole: Path) -> list[str]:
    """Where two runs' weights, optimizers, stage, configuration or scores differ."""
    parts = ("state_dict", "optimizer_states", "batches_seen", "global_step", "dvgo", "splat", "config")
    left, right = ({part: checkpoint(each).get(part) for part in parts} for each in (run, whole))
    return [*differing(left, right), *differing(scores(run), scores(whole), "scores")]


def work(config: dict[str, Any], run: Path) -> None:
    """A run, begun or gone on with."""
    from ctm_plugin.runs.rundir import CONFIG
    from ctm_plugin.runs.train import resume, train

    torch.set_num_threads(1)
    sys.stdout = sys.stderr = open("/dev/null", "w")  # noqa: SIM115 - the process ends with it
    resume(run) if (run / CONFIG).exists() else train(config, run)


class Killer:
    """Runs in processes that are forked from a warm one, so that starting takes no time."""

    def __init__(self, config: dict[str, Any], folder: Path):
        self.config, self.folder, self.whole = config, folder, folder / "whole"
        self.finish(self.whole)
        begun = time.monotonic()
        self.finish(folder / "again")
        self.seconds = time.monotonic() - begun

    def start(self, run: Path) -> multiprocessing.Process:
        process = server().Process(target=work, args=(self.config, run))
        process.start()
        return process

    def finish(self, run: Path) -> int:
        """Begin or go on until the end; the exit code."""
        process = self.start(run)
        process.join()
        return process.exitcode

    def kill(self, name: str, moment: float, checkpoints: int = 0) -> tuple[int, list[str]]:
        """Kill a run and go on with it: the step it was killed at, and what differs then.

        Args:
            name: of its folder.
            moment: after which part of its time; of 20 ms once it has written ``checkpoints``, if it shall have any.
        """
        run = self.folder / name
        process = self.start(run)
        seen, written = 0, None
        while seen < checkpoints and process.is_alive():
            with suppress(FileNotFoundError):  # between one checkpoint and the next
                found = (run / LAST).stat().st_mtime_ns
                seen, written = seen + (found != written), found
            time.sleep(0.0005)
        process.join((0.02 if checkpoints else self.seconds) * moment)
        process.kill()
        process.join()
        saved = next((each for each in (run / LAST, run / "checkpoints/previous.ckpt") if each.exists()), None)
        step = torch.load(saved, weights_only=True)["global_step"] if saved else 0
        return step, ["no resume"] if self.finish(run) else differences(run, self.whole)


def main() -> int:
    from ctm_plugin.compose.command_line import compose

    parser = argparse.ArgumentParser()
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    generator, survived, steps = random.Random(args.seed), 0, []
    with tempfile.TemporaryDirectory() as folder:
        killer = Killer(compose(*ARGUMENTS), Path(folder))
        for index in range(args.kills):
            step, different = killer.kill(f"run{index}", generator.random())
            survived += not different
            steps.append(step)
            print(f"kill {index + 1}: last whole checkpoint of step {step}, {different or 'bit-identical in the end'}")
    print(f"{survived} of {args.kills} survived; killed at steps {min(steps)} to {max(steps)} of {6 + 14}")
    return int(survived < args.kills)


if __name__ == "__main__":
    sys.exit(main())
