"""Tiny valid data sets to break."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ctm_plugin.scenes.trajectory import hemisphere

SIZE = 8


def blender_layout(root: Path, train: int = 3, test: int = 2, channels: int = 4, depth: bool = False) -> Path:
    """A data set in Blender layout with random 8x8 pictures; depth of test views in steps of 0.25, 0 for nothing."""
    rng = np.random.default_rng(0)
    for split, count in (("train", train), ("test", test)):
        (root / split).mkdir(parents=True)
        content: dict = {"camera_angle_x": 0.7, "frames": []}
        if depth and split == "test":
            content["depth_scale"] = 0.25
        for index, pose in enumerate(hemisphere(count, 4.0, seed=1)):
            name = f"./{split}/r_{index}"
            Image.fromarray(rng.integers(0, 256, (SIZE, SIZE, channels), dtype=np.uint8)).save(root / f"{name}.png")
            frame = {"file_path": name, "transform_matrix": pose.tolist()}
            if depth and split == "test":
                code = rng.integers(0, 30, (SIZE, SIZE)).astype(np.uint16)
                Image.fromarray(code).save(root / f"{name}_depth.png")
                frame["depth_file_path"] = f"{name}_depth.png"
            content["frames"].append(frame)
        (root / f"transforms_{split}.json").write_text(json.dumps(content))
    return root


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
