"""From a folder of photographs to lit views and a film: one command that decides what there is to decide."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from ctm_plugin.cameras.photographs import list_photographs, of_one_size
from ctm_plugin.cameras.settings import CamerasConfig
from ctm_plugin.color.dssim import dssim
from ctm_plugin.data.readers.folders import is_picture, require_folder
from ctm_plugin.data.readers.layouts import layouts
from ctm_plugin.errors import CheckpointError, ConfigError
from ctm_plugin.runs.compose import compose
from ctm_plugin.runs.decide import composites_there, has_gpu
from ctm_plugin.runs.rundir import CONFIG, METRICS, load_config
from ctm_plugin.runs.settings import PhotosConfig, VideoConfig
from ctm_plugin.settings.build import build
from ctm_plugin.settings.registry import DATASETS
from ctm_plugin.show.bars import whole

RUNS = Path("runs")
STEPS = {"standard": 4000, "quick": 1500}
"""Of splats, by budget."""
STEP, PIXEL = 0.025, 2.8e-7
"""Seconds of a step of splats, and more for each pixel, where a D-SSIM takes :data:`CLOCK` (benchmarks/splats.py)."""
CLOCK = 0.0013
LEAST = {"standard": 300, "quick": 160}
"""Columns of pictures from which on a budget pays."""
WIDEST = 1000
"""Columns: more show no more than a few minutes can learn."""


def photos(folder: Path, settings: PhotosConfig, others: Sequence[str] = ()) -> None:
    """Make lit views and a film of a folder of photographs: find cameras, choose geometry, size and budget, train.

    FOLDER holds the photographs, in a folder images or directly, or a data set with cameras. If it was stopped, the
    same command goes on. It prints what it decides; a key overrules it, such as dataset.width=800.

    Args:
        folder: the photographs'.
        settings: how long training may take.
        others: choices and keys of the run.

    Raises:
        CTMError: there are no photographs, cameras cannot be found, nothing can be written, or training refuses them.
    """
    if moved := next((other for other in others if other.startswith("hydra.run.dir=")), None):
        raise ConfigError("hydra.run.dir", moved.partition("=")[2], f"none: it writes into {RUNS}/ where it is started")
    root = require_folder(folder, "a folder with photographs")
    run, name = run_folder(root, settings.again), "images" if home_of(root) == root else home_of(root).name
    searching = not layouts(root) and not (run / METRICS).exists()
    if searching:
        of_one_size(list_photographs(root, name))
    check_writable(run)
    # These take seconds to import: what lies in the folder is refused before.
    from ctm_plugin.cameras.command import place, tell
    from ctm_plugin.runs.train import resume, train
    from ctm_plugin.runs.video import film
    from ctm_plugin.show.console import output_console, print_next

    console = output_console()

    def say(text: str) -> None:
        console.print(text, soft_wrap=True, highlight=False, markup=False)

    with whole(parts(root, 60 * settings.minutes)):
        if searching:
            say("cameras: none found; COLMAP searches for them in brightened copies")
            tell(root, *place(root, CamerasConfig(pictures=name)))
        if film_of(run):
            say(f"{run} is finished: again=true trains again")
        elif (run / CONFIG).exists():
            say(f"going on with {run}, with its own settings")
        if not (run / CONFIG).exists():
            train(compose(*choices(root, settings.minutes, others, say)), run, lambda *_: None)
        elif not (run / METRICS).exists():
            resume(run, lambda *_: None)
        video = film_of(run) or film(run, VideoConfig())
    say(f"lit views: {run / 'lit'}\nfilm:      {video}\nscores:    {run / METRICS}")
    print_next("view", run)


def check_writable(run: Path) -> None:
    """Refuse a place where no run can be written, before time is spent on one.

    Raises:
        CheckpointError: it is one.
    """
    there = next(each for each in (run, *run.parents) if each.exists()).absolute()
    try:
        tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        found = f"no directory to write to ({error.strerror})"
        raise CheckpointError(there, found, f"a writable one: {RUNS}/ is made where the command is started") from error


def home_of(root: Path) -> Path:
    """Find the folder of the photographs: ``images``, else ``root`` or the only folder there with some."""
    inner = sorted(path for path in root.iterdir() if path.is_dir() and any(map(is_picture, path.iterdir())))
    if (root / "images").is_dir() or any(map(is_picture, root.iterdir())):
        return root / "images" if (root / "images").is_dir() else root
    return inner[0] if len(inner) == 1 else root


def parts(root: Path, seconds: float) -> dict[str, float]:
    """Guess how many seconds each part takes, for the bar over all of them."""
    count = sum(map(is_picture, home_of(root).iterdir()))
    finding = {} if layouts(root) else {"brightness": 0.1, "details": 0.5, "pairs": 0.5, "placed": 0.4}
    found = {what: count * each for what, each in finding.items()}
    return {**found, "training": seconds, "test views": 0.05 * count, "film": 15.0}


def film_of(run: Path) -> Path | None:
    """Find a run's film, the last thing that is made of it."""
    return next((run / "video").glob("[!.]*.*"), None)


def run_folder(root: Path, again: bool) -> Path:
    """Find the run of these photographs, an unfinished one if ``again``; a new folder where there is none."""
    number = 1
    while (run := RUNS / (root.resolve().name + f"_{number}" * (number > 1))).exists():
        try:
            own = Path(load_config(run)["dataset"].get("root", "")).resolve() == root.resolve()
        except CheckpointError:
            own = not any(run.iterdir())
        if own and not (again and film_of(run)):
            return run
        number += 1
    return run


def choices(root: Path, minutes: float, others: Sequence[str], say: Callable[[str], None]) -> list[str]:
    """Choose the layout, the pictures' width and the budget, and say so; what is given stays."""
    layout = layouts(root)[0]
    chosen = {"dataset": layout, "dataset.root": root.resolve(), "ctm": "auto"}
    given = {other.partition("=")[0].lstrip("+") for other in others}
    config = compose(*_overrides(chosen, given), "trainer=smoke", *others)
    dataset = {key: value for key, value in config["dataset"].items() if key != "name"}
    rig = build(DATASETS.get(layout), dataset, "dataset").rig()
    chosen["dataset.geometry"] = dataset["geometry"]
    sized = given & {"dataset.width", "dataset.downscale", "dataset.factor"}
    width, chosen["trainer"] = plan(rig.size, minutes)
    if not sized:
        chosen["dataset.width"] = width
    size = rig.size[1] if sized else width
    budget = config["trainer"]["budget"] if "trainer" in given else f"{chosen['trainer']}, for minutes={minutes:g}"
    say(f"{len(rig.c2w)} photographs, {size} pixels wide, budget {budget}")
    return [*_overrides(chosen, given), *others]


def _overrides(chosen: dict[str, object], given: set[str]) -> list[str]:
    return [f"{key}={value}" for key, value in chosen.items() if key not in given]


def plan(size: tuple[int, int], minutes: float) -> tuple[int, str]:
    """Choose the pictures' width and the budget that splats are trained with in so many minutes on this machine.

    Args:
        size: height and width of the photographs.
        minutes: of training.
    """
    height, width = size
    most = min(width, WIDEST)
    if has_gpu() and composites_there():
        return most, "standard"
    slower = clock() / CLOCK
    for budget, steps in STEPS.items():
        pixels = (60 * minutes / steps / slower - STEP) / PIXEL
        columns = math.sqrt(max(pixels, 0) * width / height)
        if columns >= LEAST[budget]:
            break
    return min(most, max(round(columns), LEAST["quick"])), budget


def clock() -> float:
    """Seconds that a D-SSIM of 250x187 pixels takes here with its gradient, the least of a few."""
    first, second = (torch.rand(3, 187, 250, requires_grad=True) for _ in range(2))
    seconds = []
    for _ in range(20):
        start = time.perf_counter()
        dssim(first, second.detach()).backward()
        seconds.append(time.perf_counter() - start)
    return min(seconds)
