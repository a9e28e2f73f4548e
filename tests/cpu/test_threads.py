"""Threads that sleep while they wait, and how many there are."""

import os
import subprocess
import sys
import warnings

import numba
import pytest
import torch

from ctm_plugin.color.dssim import dssim
from ctm_plugin.cpu import threads
from ctm_plugin.cpu.threads import WAIT_VARIABLES, let_waiting_threads_sleep, loop_threads, operators_on_one_thread


@pytest.mark.parametrize("given", [{}, {"OMP_WAIT_POLICY": "active"}, {"GOMP_SPINCOUNT": "7"}])
def test_the_environment_has_the_last_word(monkeypatch, given):
    for name in WAIT_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    let_waiting_threads_sleep()
    found = {name: os.environ[name] for name in WAIT_VARIABLES if name in os.environ}
    monkeypatch.setenv("GOMP_SPINCOUNT", "")  # is taken away again
    assert found == (given or {"GOMP_SPINCOUNT": str(threads.MAX_SPINS)})


def test_the_command_line_says_it_before_torch_is_loaded():
    script = (
        "import os, sys\nfrom ctm_plugin import cli\ncli.main(['--version'])\n"
        "print('torch' in sys.modules, 'numba' in sys.modules, os.environ['GOMP_SPINCOUNT'])"
    )
    environment = {name: value for name, value in os.environ.items() if name not in WAIT_VARIABLES}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == f"False False {threads.MAX_SPINS}", done.stderr


def test_operators_on_one_thread_and_loops_on_all(monkeypatch):
    before, seen = torch.get_num_threads(), []
    picture = torch.rand(3, 16, 16)
    monkeypatch.setattr(numba, "set_num_threads", seen.append)
    torch.set_num_threads(2)
    try:
        with operators_on_one_thread():
            assert (torch.get_num_threads(), loop_threads()) == (1, 2)
            dssim(picture, picture)
        assert (torch.get_num_threads(), loop_threads()) == (2, 2)
        with operators_on_one_thread(False):
            assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert seen == [min(2, numba.config.NUMBA_NUM_THREADS)]


@pytest.mark.parametrize(("load", "told", "count"), [(99.0, False, 1), (0.1, False, 0), (99.0, True, 0)])
def test_python_is_warned_only_when_it_matters(monkeypatch, load, told, count):
    for name in WAIT_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    if told:
        monkeypatch.setenv("OMP_WAIT_POLICY", "passive")
    monkeypatch.setattr(os, "getloadavg", lambda: (load, load, load))
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        threads.warn_of_neighbours()
    assert len(caught) == count
