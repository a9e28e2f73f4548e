"""How far two folders' pictures of the same names are shifted against each other, by their pixels alone.

``python benchmarks/shift.py FIRST SECOND``, as of LOM's ``low`` and ``high``: pairs of one size, in any light. Steps
of Gauss and Newton (B. Lucas and T. Kanade, IJCAI 1981) on luminance without its slow parts, over its local contrast.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from PIL import Image
from scipy.ndimage import gaussian_filter, shift

from ctm_plugin.color.light import LUMINANCE
from ctm_plugin.data.readers.folders import is_picture

FINE, COARSE, CONTRAST = (3.0, 1.5), 6, 12.0
"""Standard deviations in pixels of the Gaussians that take noise and JPEG's blocks away, one after the other; how many
times wider that of the slow parts is; and that of the window of local contrast."""
EDGE, STEPS = 12, 15
"""Pixels along the edges that do not count, and most steps of each fineness."""
LINEAR = np.where((codes := np.arange(256) / 255) <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
"""Linear light of the levels of 8 bits."""


def detail(light: Float64[np.ndarray, "h w"], sigma: float) -> Float64[np.ndarray, "h w"]:
    """Luminance between two blurs of ``sigma`` and ``COARSE sigma``, in units of its deviation round each pixel."""
    fine = gaussian_filter(light, sigma) - gaussian_filter(light, COARSE * sigma)
    contrast = np.sqrt(gaussian_filter(fine**2, CONTRAST))
    return fine / (contrast + 0.02 * contrast.max() + 1e-12)


def shift_of(
    first: Float64[np.ndarray, "h w"], second: Float64[np.ndarray, "h w"]
) -> tuple[Float64[np.ndarray, " 2"], float]:
    """Right and down in pixels from where ``first`` shows a thing to where ``second`` does, and their correlation then.

    ``argmin_{d, a, b} sum (first(x) - a second(x + d) - b)^2`` over both pictures' :func:`detail`.
    """
    inside = (slice(EDGE, -EDGE),) * 2
    moved = np.zeros(2)
    for sigma in FINE:
        here, there = detail(first, sigma), detail(second, sigma)
        for _ in range(STEPS):
            seen = shift(there, -moved[::-1], order=3, mode="nearest")
            down, right = np.gradient(seen)
            rows = np.stack([each[inside].ravel() for each in (right, down, seen, np.ones_like(seen))], 1)
            found = np.linalg.lstsq(rows, here[inside].ravel(), rcond=None)[0]
            step = found[:2] / found[2]
            moved += step
            if np.abs(step).max() < 1e-3:
                break
    return moved, float(np.corrcoef(seen[inside].ravel(), here[inside].ravel())[0, 1])


def light_of(path: Path) -> Float64[np.ndarray, "h w"]:
    """A picture's luminance, linear, of 8 bits."""
    return LINEAR[np.asarray(Image.open(path).convert("RGB"))] @ np.array(LUMINANCE)


def main() -> None:
    first, second = map(Path, sys.argv[1:3])
    paths = [path for path in sorted(first.iterdir()) if is_picture(path) and (second / path.name).is_file()]
    shifts = []
    for path in paths:
        moved, alike = shift_of(light_of(path), light_of(second / path.name))
        shifts.append(np.linalg.norm(moved))
        print(f"{path.name}: {moved[0]:+.2f} right, {moved[1]:+.2f} down, correlation {alike:.2f}")
    print(f"{len(paths)} pairs: median {np.median(shifts):.2f} pixels, mean {np.mean(shifts):.2f}", end=", ")
    print(f"largest {np.max(shifts):.2f}, above 0.2 in {np.sum(np.array(shifts) > 0.2)}")


if __name__ == "__main__":
    main()
