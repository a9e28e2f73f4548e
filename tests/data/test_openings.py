"""How often files are opened from the name of a folder to the first step."""

import builtins
import io
import os
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from ctm_plugin.cli import main

CAMERAS = (".bin", ".json")


@pytest.fixture
def opened(monkeypatch) -> Counter[Path]:
    """How often each file has been opened by Python."""
    counts: Counter[Path] = Counter()
    own = builtins.open

    def counting(file: Any, *args: Any, **more: Any) -> Any:
        if not isinstance(file, int):
            counts[Path(os.fsdecode(file))] += 1
        return own(file, *args, **more)

    monkeypatch.setattr(builtins, "open", counting)
    monkeypatch.setattr(io, "open", counting)
    return counts


@pytest.mark.parametrize("folder", ["ball", "hall", "yard"])
def test_a_picture_is_opened_for_its_header_and_once_more_for_its_pixels(folder, request, tmp_path, untrained, opened):
    """Headers are read of all pictures before the pixels of any: together they say how large all become."""
    root = Path(shutil.copytree(request.getfixturevalue(folder), tmp_path / "new"))
    opened.clear()
    with pytest.raises(AssertionError, match="training has begun"):
        main([f"dataset.root={root}", "trainer=smoke", "logger=none", f"hydra.run.dir={tmp_path / 'run'}"])
    pictures = [path for path in opened if path.suffix == ".png" and "depth" not in str(path)]
    assert len(pictures) >= 9
    assert {opened[path] for path in pictures} == {2}
    assert {opened[path] for path in opened if path.is_relative_to(root) and path.suffix in CAMERAS} <= {1}
