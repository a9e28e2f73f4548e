"""Tiny valid data sets to break."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from layouts import blender_layout


def premultiplied_mean(levels: np.ndarray, factor: int) -> np.ndarray:
    """Premultiplied box average in float64: ``[H, W, 4]`` uint8 to ``[H/f, W/f, 4]`` in [0, 255]."""
    height, width = levels.shape[0] // factor, levels.shape[1] // factor
    blocks = levels.astype(np.float64).reshape(height, factor, width, factor, 4)
    weight = blocks[..., 3:].sum(axis=(1, 3))
    colour = (blocks[..., :3] * blocks[..., 3:]).sum(axis=(1, 3)) / np.maximum(weight, 1e-9)
    return np.concatenate([colour, weight / factor**2], axis=-1)


@pytest.fixture(scope="session")
def write_blender() -> Callable[..., Path]:
    return blender_layout


@pytest.fixture(scope="session")
def shrink_oracle() -> Callable[[np.ndarray, int], np.ndarray]:
    return premultiplied_mean


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A valid data set of 3 training and 2 test views."""
    return blender_layout(tmp_path / "tiny")
