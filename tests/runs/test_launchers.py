"""Sweeps through Hydra's launchers: over cores, and as SLURM's jobs would run."""

import json
from pathlib import Path

import pytest
from joblib.externals.loky import get_reusable_executor

import ctm_plugin
from ctm_plugin.cli import main
from ctm_plugin.runs.rundir import METRICS

SIZES = ("backbone.coarse=false", "backbone.steps_alone=2", "backbone.grow=[]", "backbone.rays=16")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings", "seeds"), [("joblib", ["hydra.launcher.n_jobs=2"], [0, 1]), ("submitit_local", [], [1])]
)
def test_a_sweep_through_a_launcher(arguments, tmp_path, monkeypatch, name, settings, seeds):
    """The launcher starts the processes of the jobs, each of which imports everything: two at once by the first."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(ctm_plugin.__file__).parents[1]))
    command = ["-m", *arguments, *SIZES, "ctm=off", f"seed={','.join(map(str, seeds))}"]
    command += [f"hydra/launcher={name}", *settings]
    assert main([*command, f"hydra.sweep.dir={tmp_path}/sweep"]) == 0
    if name == "joblib":  # its processes wait for more
        get_reusable_executor(reuse=True).shutdown(kill_workers=True)
    found = [json.loads(path.read_text()) for path in sorted((tmp_path / "sweep").rglob(METRICS))]
    assert [metrics["seed"] for metrics in found] == seeds
    assert all(metrics["steps"] == 2 and metrics["psnr"] > 0 for metrics in found)
