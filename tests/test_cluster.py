"""The job script of docs/cluster.md, with stand-ins for SLURM's commands and for the training."""

import os
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "docs" / "cluster.md"
STAND_INS = {
    "srun": '#!/bin/bash\necho $$ > pid\nexec "$@"\n',
    "scontrol": '#!/bin/bash\necho "$@" > requeued\n',
    # Trains until it is told to stop, as a new run, and is done at once when it goes on.
    "python": """#!/bin/bash
echo "$@" >> calls
[[ $* == *resume=* ]] && exit 0
[[ $* == *broken* ]] && exit 1
trap 'exit 75' TERM
mkdir -p runs/slurm_7 && touch runs/slurm_7/config.yaml
for _ in {1..600}; do sleep 0.05; done
""",
}


@pytest.fixture
def job(tmp_path, monkeypatch):
    """``job(*arguments)``: the script, begun as SLURM's job 7 in an empty folder."""
    (tmp_path / "bin").mkdir()
    for name, text in STAND_INS.items():
        (tmp_path / "bin" / name).write_text(text)
        (tmp_path / "bin" / name).chmod(0o755)
    (text,) = re.findall(r"```shell\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    (tmp_path / "job.sh").write_text(text)
    monkeypatch.chdir(tmp_path)
    environment = {**os.environ, "PATH": f"{tmp_path}/bin{os.pathsep}{os.environ['PATH']}", "SLURM_JOB_ID": "7"}
    return lambda *arguments: subprocess.Popen(["bash", "job.sh", *arguments], env=environment)


def test_a_job_that_is_told_to_stop_is_put_back_and_goes_on(job):
    first = job("ctm=quick", "dataset.root=a folder")
    until = time.monotonic() + 60
    while not Path("runs/slurm_7/config.yaml").exists() and time.monotonic() < until:
        time.sleep(0.02)
    os.kill(int(Path("pid").read_text()), signal.SIGTERM)
    assert first.wait(60) == 75
    assert Path("requeued").read_text() == "requeue 7\n"
    assert job("ctm=quick").wait(60) == 0
    assert Path("calls").read_text().splitlines() == [
        "-m ctm_plugin ctm=quick dataset.root=a folder hydra.run.dir=runs/slurm_7",
        "-m ctm_plugin resume=runs/slurm_7",
    ]


def test_a_job_that_fails_is_not_put_back(job):
    assert job("broken=true").wait(60) == 1
    assert not Path("requeued").exists()
