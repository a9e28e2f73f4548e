"""Sweeps through Hydra's launchers: over cores, and as SLURM's jobs would run."""

import json
from pathlib import Path

import pytest
from joblib.externals.loky import get_reusable_executor

import ctm_plugin
from ctm_plugin.cli import main
from ctm_plugin.runs.rundir import METRICS

SIZES = ("backbone.coarse=false", "backbone.steps_alone=2", "backbone.grow=[]", "backbone.rays=16")


@pytest.mark.parametrize("launcher", [("joblib", "hydra.launcher.n_jobs=2"), ("submitit_local",)], ids=lambda x: x[0])
def test_a_sweep_through_a_launcher(arguments, tmp_path, monkeypatch, launcher):
    """The launcher starts the processes of the jobs."""
    name, *settings = launcher
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(ctm_plugin.__file__).parents[1]))
    command = ["-m", *arguments, *SIZES, "ctm=off", "seed=0,1", f"hydra/launcher={name}", *settings]
    assert main([*command, f"hydra.sweep.dir={tmp_path}/sweep"]) == 0
    if name == "joblib":  # its processes wait for more
        get_reusable_executor(reuse=True).shutdown(kill_workers=True)
    found = [json.loads(path.read_text()) for path in sorted((tmp_path / "sweep").rglob(METRICS))]
    assert [metrics["seed"] for metrics in found] == [0, 1]
    assert all(metrics["steps"] == 2 and metrics["psnr"] > 0 for metrics in found)
