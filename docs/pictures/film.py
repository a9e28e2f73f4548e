"""The film in README.md: ``python docs/pictures/film.py RUN_DIR``, of a run of ``ctm backbone=splat trainer=standard``.

A dark photograph that the run never saw; a line wipes over to the lit view from its place; then once around.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from ctm_plugin.cpu.products import fast_products
from ctm_plugin.data.readers.images import to_8_bits
from ctm_plugin.export.video import encoded, rendered
from ctm_plugin.runs.load import load_posed
from ctm_plugin.scene.camera_paths import looked_at, mean_up
from ctm_plugin.scene.views import Views

OUT = Path(__file__).with_name("film.webp")
VIEW, TIMES = 3, 3
"""Number of the test view, and pixels of the film for one of its photograph, along a side."""
ROWS = slice(28, 364)
"""Rows of a frame that show something."""
FPS, STILL, WIPE, ROUND = 20, 16, 24, 100
"""Frames a second, and frames in which the photograph stands, the line moves, the camera goes around."""


def main(run: Path) -> None:
    posed = load_posed(run)
    scene, light = posed.module.scene, posed.light
    test = scene.test
    photograph = Image.fromarray(to_8_bits(posed.module.target(VIEW)).numpy())
    size = (test.width * TIMES, test.height * TIMES)
    dark = label(np.asarray(photograph.resize(size, Image.Resampling.LANCZOS)), "a photograph taken in the dark")
    pixels = torch.zeros(1, *size[::-1], test.images.shape[-1], dtype=test.images.dtype)
    lens = test.intrinsics[VIEW : VIEW + 1] * TIMES
    start = test.c2w[VIEW].cpu().double().numpy()
    centre, up = looked_at(scene.train.c2w.cpu().double().numpy(), damping=1e-9), mean_up(scene.train)
    cameras = [Views(pixels, pose, lens, ("frame",)) for pose in around(start, centre, up)]
    with fast_products(posed.module.device):
        views = rendered(posed.module, cameras)
        lit = [label(to_8_bits(posed.picture(view, "lit", light)).numpy(), "the lit scene") for view in views]
    frames = [dark] * STILL
    for share in np.linspace(0, 1, WIPE + 2)[1:-1]:
        at = round(size[0] * (0.5 - 0.5 * np.cos(np.pi * share)))
        both = np.concatenate([lit[0][:, :at], dark[:, at:]], axis=1)
        both[:, max(at - 1, 0) : at + 1] = 255
        frames.append(both)
    OUT.write_bytes(encoded(np.stack([*frames, *lit]), ".webp", FPS))


def around(c2w: np.ndarray, centre: np.ndarray, up: np.ndarray) -> torch.Tensor:
    """A camera turned once around an axis, beginning and ending slowly: ``[ROUND, 1, 3, 4]``."""
    times = np.linspace(0, 1, ROUND)
    angles = 2 * np.pi * (times - np.sin(2 * np.pi * times) / (2 * np.pi))
    cross = np.cross(np.eye(3), up)
    poses = []
    for angle in angles:
        turn = np.eye(3) - np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross  # Rodrigues
        poses.append(np.concatenate([turn @ c2w[:, :3], (centre + turn @ (c2w[:, 3] - centre))[:, None]], axis=1))
    return torch.from_numpy(np.stack(poses)).float()[:, None]


def label(frame: np.ndarray, text: str) -> np.ndarray:
    """Rows of a frame, with a line of text."""
    picture = Image.fromarray(frame[ROWS])
    ImageDraw.Draw(picture).text((12, picture.height - 28), text, fill="white", font=ImageFont.load_default(15))
    return np.asarray(picture)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
