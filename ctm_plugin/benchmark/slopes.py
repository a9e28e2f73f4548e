"""How the cost of a step and of a view grows with the batch, the grid and the picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import linear_regression

PICTURES = {16 // down**2: f"dataset.downscale={down}" for down in (4, 2, 1)}
SLOPES: dict[str, dict[str, dict[int, str]]] = {
    "dvgo": {
        "rays": {rays: f"backbone.rays={rays}" for rays in (512, 1024, 2048, 4096)},
        "voxels": {side**3: f"backbone.voxels={side**3}" for side in (48, 64, 96, 128)},
        "pixels of a picture": PICTURES,
    },
    "nerf": {"rays": {rays: f"backbone.rays={rays}" for rays in (64, 128, 256)}, "pixels of a picture": PICTURES},
    "barf2d": {
        "pixels": {pixels: f"backbone.pixels={pixels}" for pixels in (1350, 4050, 12150)},
        "pixels of a picture": {
            parts**2: f"dataset.height={90 * parts} dataset.width={120 * parts} dataset.patch={45 * parts}"
            for parts in (2, 3, 4)
        },
    },
}
"""What is varied for a backbone: sizes, up to a factor, and the overrides that give them."""


def slope(sizes: Sequence[float | int], costs: Sequence[float | int]) -> float:
    """Fit the exponent a of ``cost = b size^a``, by least squares of the logarithms.

    Example:
        >>> round(slope([1, 2, 4], [3, 6, 12]), 6)
        1.0
    """
    return linear_regression(list(map(math.log, sizes)), list(map(math.log, costs))).slope
