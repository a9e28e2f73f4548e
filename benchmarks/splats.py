"""Splats under the clock: a view and a step by their number and by the picture's size, and what a step is made of.

    python benchmarks/splats.py                 # one thread and two
    python benchmarks/splats.py threads=1 most=10000

Gaussians are spread through a frustum and shrink as their number grows, so that each pixel meets as many.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence

import torch

from ctm_plugin.color.dssim import dssim
from ctm_plugin.optim.grid_adam import GridAdam
from ctm_plugin.scene.views import Views
from ctm_plugin.settings.build import pairs
from ctm_plugin.splats.gaussians import Camera, Gaussians, camera_of
from ctm_plugin.splats.render import PLANE_CHANNELS, picture

SIZES = ((250, 187), (500, 375))
COUNTS = (10_000, 30_000, 50_000)
DEGREES = 2
LENS = (0.04, -0.2, 0.0, 0.0, 0.0)


def spread(
    count: int, width: int, height: int, degrees: int = DEGREES, distortion: Sequence[float] = LENS
) -> tuple[Gaussians, Camera]:
    """Gaussians in front of a lens."""
    draws = torch.Generator().manual_seed(0)
    depth, focal = 3 + 3 * torch.rand(count, generator=draws), 1.48 * width
    across = (torch.rand(count, 2, generator=draws) - 0.5) * torch.tensor([width, height]) / focal * depth[:, None]
    size = 0.12 * (3000 / count) ** 0.5
    gaussians = Gaussians(
        torch.cat([across, depth[:, None]], 1),
        torch.tensor(size).log() + 0.6 * torch.randn(count, 3, generator=draws) - 0.3,
        torch.randn(count, 4, generator=draws),
        torch.randn(count, 1, generator=draws) * 1.5,
        torch.rand(count, 3, generator=draws),
        0.1 * torch.randn(count, 3 * (degrees**2 - 1), generator=draws),
    )
    views = Views(
        torch.zeros(1, height, width, 3, dtype=torch.uint8),
        torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))[None, :3].contiguous(),
        torch.tensor([[focal, focal, width / 2, height / 2]]),
        ("view",),
        distortion=torch.tensor([distortion]),
    )
    return Gaussians(*(table.requires_grad_() for table in gaussians)), camera_of(views, 0, 0.2)


def milliseconds(
    runs: dict[str, Callable[[], object]], times: int = 9, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """The least of some turns of each by a clock in seconds, after one that warms up."""
    found = {name: [] for name in runs}
    for _ in range(times + 1):
        for name, run in runs.items():
            start = clock()
            run()
            found[name].append(1e3 * (clock() - start))
    return {name: min(each[1:]) for name, each in found.items()}


def measure(count: int, width: int, height: int) -> dict[str, float]:
    """Milliseconds by name."""
    gaussians, camera = spread(count, width, height)
    shift, target = torch.zeros(count, 2, requires_grad=True), torch.rand(3, height, width)
    adam = GridAdam(list(gaussians), 1e-9)

    def view() -> None:
        with torch.no_grad():
            picture(gaussians, camera, shift, DEGREES, 0.0, PLANE_CHANNELS)

    def both() -> None:
        picture(gaussians, camera, shift, DEGREES, 0.0, 0)[0].mean().backward()

    def step() -> None:
        adam.zero_grad()
        image, _ = picture(gaussians, camera, shift, DEGREES, 0.0, 0)
        (0.8 * (image - target).abs().mean() + 0.2 * dssim(image, target)).backward()
        adam.step()

    return milliseconds({"view with depth": view, "there and back": both, "step": step})


def main(arguments: list[str]) -> None:
    """Print a line for each size, number and number of threads."""
    given = pairs(arguments)
    threads = [int(given["threads"])] if "threads" in given else [1, 2]
    for width, height in SIZES:
        for count in COUNTS:
            if count <= int(given.get("most", COUNTS[-1])):
                for number in threads:
                    torch.set_num_threads(number)
                    found = measure(count, width, height)
                    told = ", ".join(f"{name} {value:.1f} ms" for name, value in found.items())
                    print(f"{width}x{height}, {count} Gaussians, {number} threads: {told}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
