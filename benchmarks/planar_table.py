"""The paper's Table 3 out of finished runs: means and standard errors over seeds, and CTM's paired differences.

``python benchmarks/planar_table.py SWEEP...``, where each SWEEP holds run directories of ``backbone=barf2d``.
"""

from __future__ import annotations

import json
import statistics
import sys
from collections import defaultdict
from pathlib import Path

from omegaconf import OmegaConf

COLUMNS = {"warp_error": 4, "corner_error": 1, "patch_psnr_pooled": 2, "image_psnr": 2}
"""What is shown, with how many decimals."""
PAPER = {
    ("none", "off"): (0.3559, None), ("none", "on"): (0.2156, None), ("naive", "off"): (0.3981, None),
    ("naive", "on"): (0.3721, None), ("barf", "off"): (0.2922, 26.22), ("barf", "on"): (0.2357, 29.24),
}  # fmt: skip
"""The paper's own, of its own pictures at 5000 steps: warping error, and patch PSNR where the brief quotes it."""


def mean(values: list[float], decimals: int, signed: bool = False) -> str:
    """Mean and standard error."""
    sign = "+" if signed else ""
    text = f"{statistics.mean(values):{sign}.{decimals}f}"
    if len(values) > 1:
        text += f" ± {statistics.stdev(values) / len(values) ** 0.5:.{decimals}f}"
    return text


def main(folders: list[str]) -> None:
    found: dict[tuple, dict[int, dict]] = defaultdict(dict)
    for path in sorted(path for folder in folders for path in Path(folder).rglob("metrics.json")):
        if path.parent.name == "evaluation":
            continue
        config, metrics = OmegaConf.load(path.parent / "config.yaml"), json.loads(path.read_text())
        if config.backbone.name != "barf2d":
            continue
        what = (metrics["protocol"], config.backbone.steps, config.backbone.pixels or "all")
        found[(*what, config.backbone.encoding, config.ctm.preset)][config.seed] = metrics
    for what in sorted({key[:3] for key in found}, key=str):
        protocol, steps, pixels = what
        print(f"\n{protocol}; {steps} steps of {pixels} pixels\n")
        print("| encoding | CTM | seeds | " + " | ".join(COLUMNS) + " | paper: warping error, PSNR |")
        print("|---" * (4 + len(COLUMNS)) + "|")
        for encoding in ("none", "naive", "barf"):
            presets = [key[4] for key in found if key[:4] == (*what, encoding)]
            for preset in sorted(presets, key=lambda name: (name != "off", name)):
                runs = found[(*what, encoding, preset)]
                cells = [mean([run[c] for run in runs.values()], d) for c, d in COLUMNS.items()]
                paper = ", ".join(str(v) for v in PAPER.get((encoding, preset), ()) if v is not None) or "-"
                print(f"| {encoding} | {preset} | {len(runs)} | {' | '.join(cells)} | {paper} |")
                off = found.get((*what, encoding, "off"), {})
                both = sorted(runs.keys() & off.keys())
                if preset != "off" and both:
                    cells = [mean([runs[s][c] - off[s][c] for s in both], d, signed=True) for c, d in COLUMNS.items()]
                    print(f"| | {preset} - off | {len(both)} | {' | '.join(cells)} | |")


if __name__ == "__main__":
    main(sys.argv[1:])
