"""The verb ``photos``: lit views, a film and a page of a folder of photographs, with all settings decided by itself."""

from __future__ import annotations

import shlex
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from ctm_plugin.cameras.clips import root_of, take_frames
from ctm_plugin.cameras.photographs import PICTURE_SUFFIXES, added, home_and_files, list_photographs
from ctm_plugin.cameras.raws import develop_raws
from ctm_plugin.cameras.settings import DEFAULT_FOLDER, CamerasConfig
from ctm_plugin.compose.command_line import compose
from ctm_plugin.compose.decide import composites_there, has_gpu
from ctm_plugin.data.readers.clip import CLIP_SUFFIXES
from ctm_plugin.data.readers.folders import is_picture, require_folder
from ctm_plugin.data.readers.images import read_picture
from ctm_plugin.data.readers.layouts import layouts, model_folder
from ctm_plugin.errors import CheckpointError, ConfigError, DataError
from ctm_plugin.export.settings import VideoConfig
from ctm_plugin.runs.rundir import ALL, CONFIG, METRICS, PAGE, film_of, load_config
from ctm_plugin.settings.build import build
from ctm_plugin.settings.registry import DATASETS
from ctm_plugin.show.bars import whole
from ctm_plugin.workflows.settings import PhotosConfig

RUNS = Path("runs")
"""Folder of the runs."""
NO_CAMERAS = "none found"
"""Why cameras are searched where there never were any."""
TIMED_BACKBONE = "splat"
"""The backbone whose schedule follows the clock."""
LENGTH_KEYS = {"trainer", "trainer.minutes", "backbone.steps"}
"""Keys that set the length of a training."""
TIMED_PHOTOGRAPHS = 2
"""Photographs on which steps are timed."""


def photos(folder: Path, settings: PhotosConfig, others: Sequence[str] = ()) -> None:
    """Make lit views, a film and a page of a folder of photographs: find cameras, choose geometry, size, budget, train.

    FOLDER holds photographs or clips, in a folder images or directly, or a data set with cameras; or it is a clip. If
    it was stopped, the same command goes on. It prints what it decides; a key overrules it, such as dataset.width=800.
    With --cfg job it prints that only, and does nothing.

    Args:
        folder: folder of the photographs, or a clip.
        settings: how long training may take.
        others: choices and keys of the run.

    Raises:
        CTMError: there are no photographs, cameras cannot be found, nothing can be written, or training refuses them.
    """
    root, run, why = begun(folder, settings, others)
    if why:
        take_frames(folder, DEFAULT_FOLDER)
        develop_raws(root)
        for path in list_photographs(root, DEFAULT_FOLDER):
            read_picture(path)
    # These take seconds to import: what lies in the folder is refused before.
    from ctm_plugin.cameras.command import find_and_write, tell
    from ctm_plugin.export.command import write_views
    from ctm_plugin.export.page import write_page
    from ctm_plugin.export.video import film
    from ctm_plugin.runs.load import load_posed
    from ctm_plugin.runs.train import resume, train
    from ctm_plugin.show.console import output_console, print_file, print_next

    console = output_console()

    def say(text: str) -> None:
        console.print(text, soft_wrap=True, highlight=False, markup=False)

    with whole(parts(root, 60 * settings.minutes)):
        if why:
            say(f"cameras: {why}; COLMAP searches for them in brightened copies")
            tell(root, *find_and_write(root, CamerasConfig(overwrite=why != NO_CAMERAS)))
        if (run / PAGE).exists():
            say(f"{run} is finished: again=true trains again")
        elif (run / CONFIG).exists():
            say(f"going on with {run}, with its own settings")
        if not (run / CONFIG).exists():
            train(compose(*choices(root, settings.minutes, others, say)), run, lambda *_: None)
        elif not (run / METRICS).exists():
            resume(run, lambda *_: None)
        if not (film_of(run) and (run / ALL).exists() and (run / PAGE).exists()):
            posed = load_posed(run, pictures=False)
            if not film_of(run):
                film(run, posed, VideoConfig())
            if not (run / ALL).exists():
                write_views(run, posed)
            if not (run / PAGE).exists():
                write_page(run / PAGE, run, posed, posed.light)
    say(f"lit views: {run / ALL}\nfilm:      {film_of(run)}\nscores:    {run / METRICS}")
    print_file("all of it: ", run / PAGE)
    print_next("view", run)


def dry_run(folder: Path, settings: PhotosConfig, others: Sequence[str] = ()) -> None:
    """Print what :func:`photos` would do, its training as a command, and write nothing.

    Args:
        folder, settings, others: see :func:`photos`.

    Raises:
        CTMError: what is refused before cameras are searched, or by training.
    """
    root, run, why = begun(folder, settings, others)
    if why:
        files = [folder] if root != folder else home_and_files(root, DEFAULT_FOLDER)[1]
        kinds = {"photographs": PICTURE_SUFFIXES, "clips": CLIP_SUFFIXES}
        counts = {kind: sum(path.suffix.lower() in suffixes for path in files) for kind, suffixes in kinds.items()}
        if not any(counts.values()):
            raise DataError(folder, "no photographs and no clips", "some")
        there = " and ".join(f"{count} {kind}" for kind, count in counts.items() if count)
        print(f"cameras: {why}; COLMAP would search for them in {there}")
        print(f"then width and budget would be chosen for minutes={settings.minutes:g}")
    elif (run / PAGE).exists():
        print(f"{run} is finished: again=true trains again")
        return
    elif (run / CONFIG).exists():
        print(f"it would go on with {run}, with its own settings")
    else:
        print(shlex.join(["ctm", *choices(root, settings.minutes, others, print), f"hydra.run.dir={run}"]))
    print(f"then {run} would get lit views ({ALL}/), a film (video/) and {PAGE}")


def begun(folder: Path, settings: PhotosConfig, others: Sequence[str]) -> tuple[Path, Path, str]:
    """Find a capture's folder, its run, and why cameras are to be searched, "" where they are not.

    Raises:
        CTMError: there is no such folder, no run can be written, or ``others`` name its folder.
    """
    if moved := next((other for other in others if other.startswith("hydra.run.dir=")), None):
        raise ConfigError("hydra.run.dir", moved.partition("=")[2], f"none: it writes into {RUNS}/ where it is started")
    root = root_of(folder)
    if root == folder:
        require_folder(folder, "a folder with photographs or clips, or a clip")
    run = run_folder(root, settings.again)
    check_writable(run)
    more = [] if (run / CONFIG).exists() or not root.is_dir() else added(root, DEFAULT_FOLDER)
    if more:
        return root, run, f"{len(more)} photographs were added since the search"
    return root, run, "" if layouts(root) or (run / METRICS).exists() else NO_CAMERAS


def check_writable(run: Path) -> None:
    """Refuse a place where no run can be written, before time is spent on one.

    Raises:
        CheckpointError: the place cannot be written.
    """
    there = next(each for each in (run, *run.parents) if each.exists()).absolute()
    try:
        tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        found = f"no directory to write to ({error.strerror})"
        raise CheckpointError(there, found, f"a writable one: {RUNS}/ is made where the command is started") from error


def parts(root: Path, seconds: float) -> dict[str, float]:
    """Guess the seconds of each part of the command, for the progress bar over all of them."""
    count = sum(map(is_picture, home_and_files(root, DEFAULT_FOLDER)[1]))
    finding = {} if layouts(root) else {"brightness": 0.1, "details": 0.5, "pairs": 0.5, "placed": 0.4, "refined": 0.4}
    times = {what: count * each for what, each in finding.items()}
    return {
        **times,
        "training": seconds,
        "test views": 0.05 * count,
        "film": 15.0,
        ALL: 0.3 * count,
        "colours": 20.0,
        "page": 5.0,
    }


def run_folder(root: Path, again: bool) -> Path:
    """Find the run of these photographs, an unfinished one if ``again``; a new folder where there is none."""
    number = 1
    while (run := RUNS / (root.resolve().name + f"_{number}" * (number > 1))).exists():
        try:
            own = Path(load_config(run)["dataset"].get("root", "")).resolve() == root.resolve()
        except CheckpointError:
            own = not any(run.iterdir())
        if own and not (again and (run / PAGE).exists()):
            return run
        number += 1
    return run


def choices(root: Path, minutes: float, others: Sequence[str], say: Callable[[str], None]) -> list[str]:
    """Choose the layout, the pictures' width and the budget, and print them; keys that are given stay."""
    import torch

    from ctm_plugin.appearance.measured_gains import SIZE, UNEVEN, gains_by_points
    from ctm_plugin.runs.assemble import assemble, load_scene
    from ctm_plugin.workflows.plan import REFERENCE, TIMED_COLUMNS, plan, timed_steps

    layout = layouts(root)[0]
    chosen = {"dataset": layout, "dataset.root": root.resolve(), "ctm": "auto"}
    given = {other.partition("=")[0].lstrip("+") for other in others}
    config = compose(*_overrides(chosen, given), "trainer=smoke", *others)
    dataset = {key: value for key, value in config["dataset"].items() if key != "name"}
    rig = build(DATASETS.get(layout), dataset, "dataset").rig()
    chosen["dataset.geometry"] = dataset["geometry"]
    sized = given & {"dataset.width", "dataset.downscale", "dataset.factor"}
    if model_folder(root) and not any(key.startswith("appearance") for key in given):
        small = {} if sized else {"dataset.width": min(SIZE, rig.size[1])}
        gains = gains_by_points(load_scene(compose(*_overrides(chosen | small, given), "trainer=smoke", *others)))
        if gains is not None and (spread := float(gains[gains.isfinite()].std(correction=0))) > UNEVEN:
            chosen["appearance"] = "exposure"
            say(f"appearance=exposure, started at the points' light: the photographs' exposures spread by {spread:.0%}")
    timed = config["backbone"]["name"] == TIMED_BACKBONE and not given & LENGTH_KEYS
    step = None if has_gpu() and composites_there() else REFERENCE
    if timed and step is not None:
        tried = {"trainer": "quick", "dataset.skip": max(len(rig.c2w) // TIMED_PHOTOGRAPHS, 1)}
        tried |= {} if sized else {"dataset.width": min(TIMED_COLUMNS, rig.size[1])}
        step = timed_steps(assemble(compose(*_overrides(chosen | tried, given), *others)))
    planned = plan(rig.size, minutes, step, torch.get_num_threads(), bool(sized))
    chosen["trainer"] = planned.budget
    if timed:
        chosen["trainer.minutes"] = minutes
    if not sized:
        chosen["dataset.width"] = planned.width
    budget = config["trainer"]["budget"] if "trainer" in given else f"{planned.budget}, for minutes={minutes:g}"
    say(f"{len(rig.c2w)} photographs, {planned.width} pixels wide, budget {budget}")
    if timed and planned.told:
        say(planned.told)
    return [*_overrides(chosen, given), *others]


def _overrides(chosen: dict[str, object], given: set[str]) -> list[str]:
    return [f"{key}={value}" for key, value in chosen.items() if key not in given]
