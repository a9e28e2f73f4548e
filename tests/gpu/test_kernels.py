"""Triton's kernels where there is no GPU: in its interpreter, and compiled for one that is not there.

In processes of their own: Triton reads once whether it interprets. On a GPU itself: ``test_gpu.py``.
"""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent
pytestmark = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not there: Linux has it")


def run(*arguments: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, *arguments],
        env=os.environ | environment,
        cwd=FOLDER.parents[1],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-6000:]
    return done.stdout


@pytest.mark.slow
def test_in_the_interpreter():
    path = str(FOLDER / "in_interpreter.py")
    told = run("-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", path, TRITON_INTERPRET="1")
    assert " passed" in told
    assert " skipped" not in told


@pytest.mark.slow
def test_compiled(tmp_path):
    told = run(str(FOLDER / "compile_kernels.py"), TRITON_CACHE_DIR=str(tmp_path), TRITON_INTERPRET="0")
    made = [line.split() for line in told.splitlines()]
    assert len(made) == 12  # three of them twice, there and back
    assert all(int(size) > 1000 for _, size in made)
