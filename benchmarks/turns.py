"""Two sides in a process each, taking steps in turn: one rests while the other works; times and memory stay apart."""

from __future__ import annotations

import json
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import torch
from torch import Tensor

from ctm_plugin.backbones.radiance import RadianceBackbone
from ctm_plugin.cpu.products import fast_products
from ctm_plugin.metrics.image import psnr
from ctm_plugin.rays.cameras import Rays, pixel_rays
from ctm_plugin.scene.views import composite

SIDES = ("ours", "peer")


def answer(name: str, step: Callable[[int], Any], score: Callable[[], Any]) -> None:
    """In a side's process: answer each line on standard input with one line of JSON.

    ``step N`` is answered with seconds, peak GiB and what ``step(N)`` returns, ``score`` with what ``score()`` does.
    """
    print(json.dumps("ready"), flush=True)
    with fast_products(torch.device("cpu")) if name == "ours" else nullcontext():
        for line in sys.stdin:
            if line.startswith("score"):
                print(json.dumps(score()), flush=True)
                continue
            begun = time.perf_counter()
            result = step(int(line.split()[1]))
            seconds = time.perf_counter() - begun
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
            print(json.dumps((seconds, memory, result)), flush=True)


def view_psnr(module: RadianceBackbone, render: Callable[[Rays], Tensor], views: int | None = None) -> float:
    """Mean over the first test views, or all, of what ``render`` gives for their rays."""
    test, found = module.scene.test, []
    for index in range(len(test) if views is None else views):
        pixel = index * test.height * test.width + torch.arange(test.height * test.width)
        rays = pixel_rays(test.c2w, test.intrinsics, test.height, test.width, pixel)
        target = composite(test.images[index], module.constant_background())
        found.append(psnr(render(rays).clamp(0, 1).view_as(target), target).item())
    return statistics.mean(found)


class Turns:
    """Both processes, started with this program's own arguments and ``--work SIDE``.

    Attributes:
        found: by side, the answers to its steps: seconds, peak GiB, what the step returned.
    """

    def __init__(self) -> None:
        self.sides, self.found = {}, {name: [] for name in SIDES}
        for name in SIDES:
            command = [sys.executable, *sys.argv, "--work", name]
            self.sides[name] = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for name in SIDES:
            self._read(name)

    def step(self, number: int) -> None:
        """One step of each; who comes first alternates."""
        for name in SIDES[:: 1 if number % 2 else -1]:
            self.turn(name, number)

    def turn(self, name: str, number: int) -> float:
        """A step of one side; how many seconds it took."""
        self.found[name].append(self._ask(name, f"step {number}"))
        return self.found[name][-1][0]

    def scores(self) -> dict[str, Any]:
        return {name: self._ask(name, "score") for name in SIDES}

    def close(self) -> None:
        for side in self.sides.values():
            side.stdin.close()
            side.wait()

    def seconds(self, name: str) -> float:
        """Median of a step's; the first one pays for fresh memory."""
        steps = self.found[name]
        return statistics.median(row[0] for row in steps[1:] or steps)

    def memory(self, name: str) -> float:
        return self.found[name][-1][1]

    def ratios(self) -> str:
        """How much faster ours is, step by step."""
        pairs = zip(self.found["ours"][1:], self.found["peer"][1:], strict=True)
        ratios = [theirs[0] / ours[0] for ours, theirs in pairs] or [float("nan")]
        return f"speed, ours over the peer's: median {statistics.median(ratios):.2f}, least {min(ratios):.2f}"

    def _ask(self, name: str, line: str) -> Any:
        self.sides[name].stdin.write(f"{line}\n")
        self.sides[name].stdin.flush()
        return self._read(name)

    def _read(self, name: str) -> Any:
        for line in self.sides[name].stdout:
            try:
                return json.loads(line)
            except json.JSONDecodeError:  # the peers print as they go
                continue
        raise SystemExit(f"{name} has stopped")
