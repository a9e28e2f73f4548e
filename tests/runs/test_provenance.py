"""Fingerprints and versions."""

import subprocess
from dataclasses import dataclass, field, fields, make_dataclass, replace

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
    mask: torch.Tensor | None = field(default=None, metadata=ADDED)
    more: dict = field(default_factory=dict)


Before = make_dataclass("Before", [each.name for each in fields(Data) if each.name != "mask"])
"""As it was before a field was added."""


def test_everything_in_a_data_set_counts():
    data = Data(torch.arange(12, dtype=torch.uint8).view(2, 6))
    changed = [
        replace(data, pixels=data.pixels + 1), replace(data, pixels=data.pixels.view(3, 4)),
        replace(data, pixels=data.pixels.int()), replace(data, names=("a", "c")), replace(data, names=("ab",)),
        replace(data, near=2.5), replace(data, depth=torch.zeros(1)), replace(data, mask=torch.ones(3)),
        replace(data, more={"b": torch.ones(1).bfloat16(), "a": np.full(5000, 1.0)}),
    ]  # fmt: skip
    found = [fingerprint(each) for each in (data, *changed)]
    assert len(set(found)) == len(found)
    assert fingerprint(replace(data, pixels=data.pixels.clone())) == found[0]
    assert fingerprint(replace(data, pixels=data.pixels.t().contiguous().t())) == found[0]
    assert fingerprint(data) == fingerprint(Before(*[getattr(data, each.name) for each in fields(Before)]))
    assert versions().keys() >= {"python", "torch", "lightning", "numpy"}


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
