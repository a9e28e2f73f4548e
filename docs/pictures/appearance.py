"""A scene whose pictures were taken at two exposures, trained without an appearance and with one.

``python docs/pictures/appearance.py SWEEP ROOT``, of the runs of ``experiment=appearance`` and LOM's scene: the test
view's photographs, from ``low`` (lifted by 4 stops) and ``high``, and what the two runs render of it, lifted.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from ctm_plugin.color.light import brighten
from ctm_plugin.data.readers.images import read_image
from ctm_plugin.data.resample import shrink
from ctm_plugin.runs.rundir import load_config

STOPS, TIMES = 4, 3


def main(sweep: Path, root: Path) -> None:
    """Write the picture."""
    runs = {
        config["appearance"]["name"]: run.parent
        for run in sorted(sweep.glob("*/metrics.json"))
        if (config := load_config(run.parent))["dataset"]["mix"]
    }
    rendered = []
    for name in ("none", "exposure"):
        photo = next((runs[name] / "test").glob("*_photo.png"))
        view = photo.stem.removesuffix("_photo")
        rendered.append(read_image(photo.with_name(f"{view}_lifted.png")))
    height, width = rendered[0].shape[:2]
    dark, lit = (
        shrink(read_image(next((root / folder).glob(f"{view}.*"))), height, width) for folder in ("low", "high")
    )
    row = torch.cat([brighten(dark, 2.0**STOPS), lit, *rendered], dim=1)
    pixels = (255 * row).round().to(torch.uint8).numpy()
    Image.fromarray(np.kron(pixels, np.ones((TIMES, TIMES, 1), np.uint8))).save(Path(__file__).with_suffix(".png"))
    print(f"view {view} of {root}")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
