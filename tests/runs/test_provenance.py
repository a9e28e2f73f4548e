"""Fingerprints and versions."""

import subprocess
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from ctm_plugin import __version__
from ctm_plugin.runs import provenance
from ctm_plugin.runs.provenance import code_version, fingerprint, versions
from ctm_plugin.scene.views import ADDED


@dataclass(frozen=True)
class Data:
    pixels: torch.Tensor
    names: tuple[str, ...] = ("a", "b")
    near: float = 2.0
    depth: torch.Tensor | None = None


def test_everything_in_a_data_set_counts():
    data = Data(torch.arange(12, dtype=torch.uint8).view(2, 6))
    changed = [
        replace(data, pixels=data.pixels + 1), replace(data, pixels=data.pixels.view(3, 4)),
        replace(data, pixels=data.pixels.int()), replace(data, names=("a", "c")), replace(data, names=("ab",)),
        replace(data, near=2.5), replace(data, depth=torch.zeros(1)),
    ]  # fmt: skip
    found = [fingerprint(each) for each in (data, *changed)]
    assert len(set(found)) == len(found)
    assert fingerprint(replace(data, pixels=data.pixels.clone())) == found[0]
    assert fingerprint(replace(data, pixels=data.pixels.t().contiguous().t())) == found[0]


@dataclass(frozen=True)
class Added(Data):
    mask: torch.Tensor | None = field(default=None, metadata=ADDED)


def test_data_of_before_a_field_was_added_stay_the_same():
    data, added = (kind(torch.arange(3)) for kind in (Data, Added))
    assert fingerprint(data) == fingerprint(added) != fingerprint(replace(added, mask=torch.ones(3)))


def test_data_of_other_packages():
    def of(x: float, y: float) -> str:
        return fingerprint({"b": torch.tensor([x]).bfloat16(), "a": np.full(5000, y), "c": {"d": [x]}})

    assert of(1, 2) == of(1, 2)
    assert len({of(1, 2), of(3, 2), of(1, 4)}) == 3


def test_versions():
    assert versions()["torch"] == torch.__version__
    assert {"python", "lightning", "numpy"} <= versions().keys()


def test_the_commit_of_a_checkout(tmp_path, monkeypatch):
    def git(*arguments):
        subprocess.run(["git", "-c", "user.name=x", "-c", "user.email=x@y", *arguments], cwd=tmp_path, check=True)

    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "package" / "runs" / "provenance.py"))
    code_version.cache_clear()
    assert code_version() == __version__
    git("init", "-q")
    (tmp_path / "a").write_text("1")
    git("add", "a")
    git("commit", "-qm", "x")
    code_version.cache_clear()
    clean = code_version()
    assert clean.startswith(f"{__version__} ")
    assert len(clean.split()[1]) == 12
    (tmp_path / "a").write_text("2")
    code_version.cache_clear()
    assert code_version() == f"{clean}+"
    code_version.cache_clear()
