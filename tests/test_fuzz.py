"""Broken data sets, runs and command lines, as ``fuzz.py`` makes many more; and that it notices failures."""

import os
import re
import time
from functools import partial
from pathlib import Path
from random import Random

import numpy as np
import pytest
from fuzz import KINDS, MEMORY, Fuzzer, Told
from mutations import BYTES, OF_KIND, changed_tree

from ctm_plugin.errors import DataError

CASES = {"run": 5, "report": 8, "command line": 4, "weights": 3, "embedded": 3}
"""Of those that take longer; of the others ``USUALLY``."""
USUALLY = 8


@pytest.fixture(scope="module")
def fuzzer(tmp_path_factory):
    return Fuzzer(tmp_path_factory.mktemp("fuzz"))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_broken_works_or_is_told(fuzzer, kind):
    ended = [fuzzer.case(kind, 7, number) for number in range(CASES.get(kind, USUALLY))]
    failed = [f"case {number}: {case}" for number, case in enumerate(ended) if case[1] == "failed"]
    assert failed == []


def use(what: str, root: Path, random: Random) -> None:
    """Ends in one of the ways that are failures, or in one that is not."""
    match what:
        case "raises":
            raise KeyError("frames")
        case "waits":
            time.sleep(100)
        case "dies":
            os.abort()
        case "grows":
            np.ones(MEMORY + 2**28, dtype=np.uint8)
        case "runs out":
            try:
                np.zeros(2**50)
            except MemoryError as error:
                raise DataError(root, "a large array", "a small one") from error
        case "does not say where":
            raise DataError("somewhere", "x", "y")
        case "a command does not say where":
            raise Told("error: somewhere: found x, expected y")
        case "says too much":
            raise Told(f"error: {root} {'x' * 5000}")
        case "tells":
            raise DataError(root, "x", "y")


@pytest.mark.parametrize(
    ("what", "ended", "said"),
    [
        ("raises", "failed", "KeyError: 'frames'"),
        ("waits", "failed", "not done after 2 s"),
        ("dies", "failed", "the process ended with"),
        ("grows", "failed", "MiB of memory"),
        ("runs out", "failed", "refused for want of memory alone"),
        ("does not say where", "failed", "does not say where"),
        ("a command does not say where", "failed", "does not say where"),
        ("says too much", "failed", "a message of 50"),
        ("tells", "told", "found x, expected y"),
        ("works", "worked", ""),
    ],
)
def test_failures_are_noticed(fuzzer, tmp_path, what, ended, said):
    found = fuzzer.run(partial(use, what), tmp_path, "seed", seconds=2 if what == "waits" else 60)
    assert found[0] == ended
    assert said in found[1]


@pytest.mark.parametrize("kind", [kind for kind in KINDS if KINDS[kind].files])
def test_valid_ones_work(fuzzer, monkeypatch, kind):
    """What is broken was whole: no case is told for another reason."""
    monkeypatch.setitem(KINDS, kind, KINDS[kind]._replace(files=0))
    for number in range(3):
        assert fuzzer.case(kind, 0, number) == ("", "worked", "")


def test_mutations_are_seeded_and_change_something():
    data = bytes(range(256)) * 4
    for mutation in BYTES:
        assert mutation(data, Random(1)) == mutation(data, Random(1))
        assert any(mutation(data, Random(seed)) != data for seed in range(5))
    tree = {"a": [1, 2.5, {"b": "c"}], "d": None}
    changed = [changed_tree(tree, Random(seed)) for seed in range(50)]
    assert repr(changed) == repr([changed_tree(tree, Random(seed)) for seed in range(50)])
    assert sum(repr(each) != repr(tree) for each in changed) > 40
    assert tree == {"a": [1, 2.5, {"b": "c"}], "d": None}


def test_every_ending_has_mutations_of_its_own(tmp_path):
    for make in {kind.make for kind in KINDS.values()}:
        make(tmp_path / make.__name__)
    not_read = re.compile("README.md|SHA256SUMS|events.out.tfevents.*")
    files = [path for path in tmp_path.rglob("*") if path.is_file() and not not_read.fullmatch(path.name)]
    assert {path.suffix for path in files} <= OF_KIND.keys()
