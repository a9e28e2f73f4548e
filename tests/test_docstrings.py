"""The examples in docstrings, run."""

import doctest
import importlib
from pathlib import Path

import pytest
import torch

import ctm_plugin

ROOT = Path(ctm_plugin.__file__).parent
SHOWING = sorted(path for path in ROOT.rglob("*.py") if ">>>" in path.read_text())


def test_there_are_some():
    assert len(SHOWING) >= 6


@pytest.mark.parametrize("path", SHOWING, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_examples(path):
    name = ".".join(("ctm_plugin", *path.relative_to(ROOT).with_suffix("").parts))
    result = doctest.testmod(importlib.import_module(name), extraglobs={"torch": torch})
    assert result.attempted
    assert not result.failed
