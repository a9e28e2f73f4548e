"""``benchmarks/paper_scale.py``: every run has its share of the time, and a row, whole or cut off."""

import csv
import shutil
import signal
from pathlib import Path
from subprocess import TimeoutExpired

import pytest
from pages import load


@pytest.fixture
def started(monkeypatch, made, tmp_path):
    """The arguments of all processes: CTM's finish, those of other colours only once they are resumed."""
    scored, started = made(), []

    class Process:
        def __init__(self, command):
            self.verb, self.run = command[3], Path(command[-1].removeprefix("hydra.run.dir="))
            self.told, self.done = False, self.verb in ("resume", "evaluate") or "ctm=on" in command
            started.append(command[3:])

        def send_signal(self, number):
            self.told = number == signal.SIGTERM

        def wait(self, seconds=None):
            if not self.done and not self.told:
                raise TimeoutExpired(self.verb, seconds)
            folder = self.run / "evaluation" if self.verb == "evaluate" else self.run
            for path in (folder, self.run / "checkpoints"):
                path.mkdir(parents=True, exist_ok=True)
            (self.run / "checkpoints" / "last.ckpt").touch()
            shutil.copy(scored / "config.yaml", self.run)
            if self.done:
                shutil.copy(scored / "metrics.json", folder)

    monkeypatch.setenv("CTM_DATA", str(tmp_path))
    monkeypatch.setattr("subprocess.Popen", Process)
    return started


def test_what_is_not_finished_in_time_is_cut_off_and_scored_and_goes_on_the_next_time(started, tmp_path):
    def variants():
        own = ["minutes=1", "scenes=chair", f"out={tmp_path / 'rows.csv'}", f"runs={tmp_path / 'scaled'}"]
        load("benchmarks/paper_scale.py").main([*own, "at_once=2", "dataset.exposure=0.05"])
        with (tmp_path / "rows.csv").open(encoding="utf-8", newline="") as file:
            return [row["variant"] for row in csv.DictReader(file)]

    assert [variant.endswith("cut off after 1000 steps") for variant in variants()] == [True, False]
    new = [[f"ctm={ctm}", "seed=0", "dataset.exposure=0.05"] for ctm in ("off", "on")]
    assert [command[2:5] for command in started if len(command) > 2] == new
    assert [command[0] for command in started if len(command) == 2] == ["evaluate"]
    del started[:]
    assert not any("cut off" in variant for variant in variants())
    assert [command[0] for command in started] == ["resume"]
    (tmp_path / "rows.csv").unlink()
    assert len(variants()) == 2
