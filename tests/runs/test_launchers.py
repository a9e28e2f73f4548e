"""Sweeps through Hydra's launchers: over cores, and as SLURM's jobs would run."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import ctm_plugin
from ctm_plugin.runs.rundir import METRICS

SIZES = ("backbone.coarse=false", "backbone.steps_alone=2", "backbone.grow=[]", "backbone.rays=16")


@pytest.mark.parametrize("launcher", [("joblib", "hydra.launcher.n_jobs=2"), ("submitit_local",)], ids=lambda x: x[0])
def test_a_sweep_through_a_launcher(arguments, tmp_path, launcher):
    name, *settings = launcher
    command = [sys.executable, "-m", "ctm_plugin", "-m", *arguments, *SIZES, "ctm=off", "seed=0,1"]
    command += [f"hydra/launcher={name}", *settings, f"hydra.sweep.dir={tmp_path}/sweep"]
    environment = os.environ | {"PYTHONPATH": str(Path(ctm_plugin.__file__).parents[1])}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    found = [json.loads(path.read_text()) for path in sorted((tmp_path / "sweep").rglob(METRICS))]
    assert [metrics["seed"] for metrics in found] == [0, 1]
    assert all(metrics["steps"] == 2 and metrics["psnr"] > 0 for metrics in found)
