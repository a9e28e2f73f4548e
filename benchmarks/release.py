"""A training step of this checkout next to one of another, such as the last release's, in turns: before each release.

``python benchmarks/release.py CHECKOUT [rounds=3] [key=value ...]``

Each round runs ``benchmarks/step.py`` with the same keys in both checkouts, in a process each, the order changing.
Prints the medians of a step without a transform and with it, and the ratio of this checkout's to the other's.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).parents[1]


def measured(checkout: Path, arguments: Sequence[str]) -> dict[str, float]:
    """Milliseconds of a step by backbone and side, ``dvgo off``."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "step.json")
        command = [sys.executable, "benchmarks/step.py", *arguments, f"out={out}"]
        environment = {**os.environ, "PYTHONPATH": str(checkout)}
        subprocess.run(command, cwd=checkout, env=environment, check=True, stdout=subprocess.DEVNULL)
        found = json.loads(out.read_text(encoding="utf-8"))
    return {f"{name} {side}": found[name][side]["step_ms"] for name in found for side in ("off", "on")}


def main(other: str, *arguments: str) -> None:
    """Measure both, and print a line for each backbone and side."""
    rounds = next((int(each.partition("=")[2]) for each in arguments if each.startswith("rounds=")), 3)
    given = [each for each in arguments if not each.startswith("rounds=")]
    checkouts = {"this": HERE, "other": Path(other).resolve()}
    times: dict[str, list[dict[str, float]]] = {name: [] for name in checkouts}
    for index in range(rounds):
        for name in sorted(checkouts, reverse=index % 2 == 0):
            times[name].append(measured(checkouts[name], given))
    for key in times["this"][0]:
        ours, theirs = (statistics.median(each[key] for each in times[name]) for name in ("this", "other"))
        print(f"{key}: {ours:.2f} ms, the other {theirs:.2f} ms, ratio {ours / theirs:.3f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
