"""The paper's presets at a chosen size within so many minutes: scenes x colours x seeds, cut off and scored in time.

``python benchmarks/paper_scale.py minutes=14 scenes=chair_800 out=rows.csv [ctm=off,on] [seeds=0] [at_once=1]
[experiment=synthetic_nerf_dark_dvgo] [runs=runs/paper_scale] [key=value ...]``

Scenes are folders below ``CTM_DATA``; further keys, such as ``dataset.exposure=0.05``, go to every run. ``at_once``
processes share the machine. Each run trains for its share of the minutes that are left, all colours and scenes of a
seed before the next seed. What is not finished by then is stopped, as by SIGTERM, scored from its checkpoint, and
named *cut off* in the column ``variant``. After each share, ``out`` holds a row of ``docs/evidence/scores.csv`` for
every run so far. The same command, given again, goes on with the runs that were cut off, and writes all rows again.
"""

from __future__ import annotations

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import product
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "docs" / "evidence"))

from scores import COLUMNS, row_of

from ctm_plugin.report.runs import read_run
from ctm_plugin.runs.rundir import CONFIG, LAST, METRICS
from ctm_plugin.settings.build import build, pairs
from ctm_plugin.settings.setting import REQUIRED, Settings, setting

CTM = (sys.executable, "-m", "ctm_plugin")
SAVING = 60
"""Seconds that a run which was told to stop may take for its checkpoint."""


@dataclass(frozen=True, kw_only=True)
class ScaleConfig(Settings):
    """What to run, and for how long."""

    minutes: float = setting(REQUIRED, "minutes for everything, scoring included", above=0)
    scenes: str = setting(REQUIRED, "folders below CTM_DATA, comma-separated")
    out: str = setting(REQUIRED, "the CSV file of scores that is written")
    ctm: str = setting("off,on", "colours, comma-separated")
    seeds: str = setting("0", "seeds, comma-separated")
    at_once: int = setting(1, "runs that share the machine", least=1)
    experiment: str = setting("synthetic_nerf_dark_dvgo", "the preset")
    runs: str = setting("runs/paper_scale", "folder of the runs")


def train(folders: dict[Path, list[str]], seconds: float) -> None:
    """Train all at once; those not finished in time stop with a checkpoint, or at once before the first step."""
    started = [subprocess.Popen([*CTM, *command]) for command in folders.values()]
    end = time.monotonic() + seconds
    for process in started:
        try:
            process.wait(max(0.0, end - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGTERM)
    for process in started:
        try:
            process.wait(SAVING)
        except subprocess.TimeoutExpired:
            process.kill()


def score(folders: Sequence[Path]) -> None:
    """Score those that were cut off, from their checkpoints, into ``RUN/evaluation``, which is then read as a run."""
    cut = [folder for folder in folders if (folder / LAST).exists() and not (folder / METRICS).exists()]
    for process in [subprocess.Popen([*CTM, "evaluate", str(folder)]) for folder in cut]:
        process.wait()
    for folder in cut:
        if (folder / "evaluation" / METRICS).exists():
            shutil.copy(folder / CONFIG, folder / "evaluation")


def rows(folder: Path) -> list[dict[str, str]]:
    """Read what runs have to say; of those without scores, nothing."""
    found = []
    for run in sorted({path.parents[1] for path in folder.glob(f"*/{LAST}")}):
        scored = next((each for each in (run, run / "evaluation") if (each / METRICS).exists()), None)
        if scored is None:
            print(f"{run}: no scores", file=sys.stderr)
            continue
        read = read_run(scored)
        row = row_of(read)
        if scored != run:
            row["variant"] = f"{row['variant']} cut off after {read.metrics['steps']} steps".strip()
        found.append(row)
    return found


def main(arguments: Sequence[str]) -> None:
    """Do the runs, share by share, and write the file after each."""
    keys = {field.name for field in fields(ScaleConfig)}
    own = [argument for argument in arguments if argument.partition("=")[0] in keys]
    others = [argument for argument in arguments if argument not in own]
    settings = build(ScaleConfig, pairs(own), "paper_scale")
    folder, data, end = Path(settings.runs), os.environ["CTM_DATA"], time.monotonic() + 60 * settings.minutes
    todo: dict[Path, list[str]] = {}
    for seed, scene, ctm in product(*(each.split(",") for each in (settings.seeds, settings.scenes, settings.ctm))):
        run = folder / f"{settings.experiment}_{scene}_{ctm}_{seed}"
        begun = ["resume", str(run)] if (run / LAST).exists() else None
        new = [f"+experiment={settings.experiment}", f"dataset.root={data}/{scene}", f"ctm={ctm}", f"seed={seed}"]
        if not (run / METRICS).exists():
            todo[run] = begun or [*new, *others, f"hydra.run.dir={run}"]
    runs, scoring = list(todo), 0.0
    shares = [runs[first : first + settings.at_once] for first in range(0, len(runs), settings.at_once)] or [[]]
    for index, share in enumerate(shares):
        left = (end - time.monotonic()) / (len(shares) - index)
        train({run: todo[run] for run in share}, left - scoring if scoring else 0.8 * left)
        begin = time.monotonic()
        score(share)
        scoring = max(scoring, time.monotonic() - begin)
        with Path(settings.out).open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows(folder))


if __name__ == "__main__":
    main(sys.argv[1:])
