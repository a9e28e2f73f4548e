"""Memory over a long run: ``python tests/long_run.py [--steps 20000] [OVERRIDE ...]``.

Runs the command line in a process of its own and watches its resident memory from outside. It prints the growth between
a quarter of the run's time and nine tenths (scoring comes last), in MiB per 1000 steps, with its standard error from
the scatter of ten parts, and fails where the growth is above three of them and above a MiB altogether.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np


def resident(pid: int) -> float:
    """MiB of a process that are in memory."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS:")), 0.0)


def slope(samples: np.ndarray, parts: int = 10) -> tuple[float, float]:
    """Growth over a row of samples, by least squares, and its standard error out of the growths of its pieces."""
    rows = [samples, *np.array_split(samples, parts)]  # samples that follow each other are alike
    growth, *pieces = (np.polyfit(np.linspace(0, 1, len(row)), row, 1)[0] for row in rows)
    return float(growth), float(np.std(pieces, ddof=1) * np.sqrt(parts))


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=20000)
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "ctm_plugin", "trainer=smoke", f"hydra.run.dir={folder}/run"]
        steps = [f"backbone.steps_alone={args.steps}", "trainer.image_every=500", "trainer.checkpoint_every=200"]
        log = open(Path(folder) / "log", "w")  # noqa: SIM115 - until the end
        process = subprocess.Popen([*command, *steps, *args.overrides], stdout=log, stderr=subprocess.STDOUT)
        samples = []
        while process.poll() is None:
            samples.append(resident(process.pid))
            time.sleep(0.25)
        if process.returncode:
            print((Path(folder) / "log").read_text())
            return process.returncode
    kept = np.array(samples[len(samples) // 4 : len(samples) * 9 // 10])
    growth, error = slope(kept)
    per_thousand = 1000 / (0.65 * args.steps)
    print(f"{args.steps} steps, {len(kept)} samples, {kept.mean():.0f} MiB on average, {kept.max():.0f} at most")
    print(f"growth {growth * per_thousand:+.3f} +- {error * per_thousand:.3f} MiB per 1000 steps")
    return int(growth > max(1.0, 3 * error))


if __name__ == "__main__":
    sys.exit(main())
