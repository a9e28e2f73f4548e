"""What other programs cost a training: alone, beside one and beside two that keep a core busy, as ratios.

    python benchmarks/neighbours.py                               # the embedded scene, splats
    python benchmarks/neighbours.py rounds=3 +experiment=lom dataset.root=FOLDER trainer=standard backbone.steps=200

Each round runs every case once, so that a machine whose speed drifts drifts for all. ``ctm`` sets what OpenMP
reads, unless the environment says otherwise.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

BUSY = "while True: pass"
CASES = {
    "one thread, alone": (0, {"OMP_NUM_THREADS": "1"}),
    "alone": (0, {}),
    "beside one": (1, {}),
    "beside two": (2, {}),
}
SCENE = ("dataset=white_room", "backbone=splat", "trainer=standard", "backbone.steps=200")


def seconds(neighbours: int, setting: dict[str, str], overrides: list[str]) -> float:
    """Seconds of training beside so many busy processes."""
    busy = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(neighbours)]
    try:
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "ctm_plugin", *overrides, f"hydra.run.dir={folder}/run"]
            command += ["logger=none"]
            done = subprocess.run(command, env=os.environ | setting, capture_output=True, text=True)
            if done.returncode:
                raise SystemExit(done.stderr)
            return json.loads(Path(folder, "run", "metrics.json").read_text())["train_seconds"]
    finally:
        for each in busy:
            each.kill()
            each.wait()


def main(arguments: list[str]) -> None:
    """Print a line for each round, then the medians' ratios."""
    rounds = [int(each.partition("=")[2]) for each in arguments if each.startswith("rounds=")] or [3]
    overrides = [each for each in arguments if not each.startswith("rounds=")] or [*SCENE]
    found: dict[str, list[float]] = {name: [] for name in CASES}
    for _ in range(rounds[-1]):
        for name, (neighbours, setting) in CASES.items():
            found[name].append(seconds(neighbours, setting, overrides))
        print(", ".join(f"{name} {each[-1]:.1f} s" for name, each in found.items()), flush=True)
    medians = {name: statistics.median(each) for name, each in found.items()}
    first = medians["one thread, alone"]
    print("of one thread alone: " + ", ".join(f"{name} {median / first:.2f}" for name, median in medians.items()))


if __name__ == "__main__":
    main(sys.argv[1:])
