"""Tiny valid data sets to break."""

from pathlib import Path

import pytest
from ctm_scenes.trajectory import hemisphere
from layouts import COUNT, blender_layout, colmap_layout


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A valid data set of 3 training and 2 test views."""
    return blender_layout(tmp_path / "tiny")


@pytest.fixture
def yard(tmp_path: Path) -> Path:
    """Nine pictures of 24x16 in COLMAP's layout."""
    return colmap_layout(tmp_path / "yard", hemisphere(COUNT, 4.0, seed=3))
