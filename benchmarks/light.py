"""Whether light is linear in pictures: those of a lit rendering, dimmed, against the same views rendered in weak light.

``python benchmarks/light.py LIT DARK``: two folders that ``python -m ctm_plugin scenes`` filled, alike but for
their light. Counts pixels of which no channel is off by more than one grey level.
"""

from __future__ import annotations

import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch

from ctm_plugin.color.light import brighten
from ctm_plugin.data.readers.records import rendered


def errors(lit: Path, dark: Path, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """Of one view: the largest difference of each foreground pixel in grey levels, and whether it is cut at 1 when lit.

    Args:
        lit, dark: pictures, RGB or RGBA.
        factor: the light of ``dark`` in terms of that of ``lit``.

    Returns:
        ``[N]`` float and ``[N]`` bool.
    """
    bright, weak = iio.imread(lit), iio.imread(dark)
    seen = bright[..., 3] > 0 if bright.shape[-1] == 4 else np.ones(bright.shape[:2], dtype=bool)
    bright, weak = bright[seen][:, :3], weak[seen][:, :3]
    expected = torch.round(255 * brighten(torch.from_numpy(bright) / 255, factor, "hard")).numpy()
    return np.abs(expected - weak).max(axis=-1), (bright == 255).any(axis=-1)


def main() -> None:
    lit, dark = (Path(folder) for folder in sys.argv[1:3])
    factor = rendered(dark, "light") / rendered(lit, "light")
    views = sorted(path.relative_to(lit) for path in lit.rglob("*.png") if "depth" not in str(path.relative_to(lit)))
    found = [errors(lit / view, dark / view, factor) for view in views]
    shares = [np.mean(off <= 1) for off, _ in found]
    off, cut = (np.concatenate(parts) for parts in zip(*found, strict=True))
    beyond = max(np.count_nonzero(off > 1), 1)
    print(f"{len(views)} views, light {factor:g}: {100 * np.mean(off <= 1):.2f} % of the pixels within one grey level")
    print(f"in the worst view {100 * min(shares):.2f} %; largest difference {off.max():g} grey levels")
    print(f"of the pixels beyond, {100 * np.sum(cut & (off > 1)) / beyond:.0f} % are cut at 1 when lit")


if __name__ == "__main__":
    main()
