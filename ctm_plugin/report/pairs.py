"""Choice of runs' pictures to compare, for reports and figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ctm_plugin.data.readers.images import read_image, to_8_bits
from ctm_plugin.errors import CheckpointError
from ctm_plugin.report.labels import differing
from ctm_plugin.report.runs import Run, weights

CROP_DIVISOR = 4
"""Ratio of a picture's sides to those of its crop."""


def pictures(run: Run) -> dict[str, Path]:
    """A run's picture files by kind, of the middle test view; ``photo`` is the target of ``lit``."""
    rows = run.metrics.get("per_image") or []
    if rows:
        name = rows[len(rows) // 2]["name"]
        paths = {kind: run.folder / kind / f"{name}.png" for kind in ("lit", "dark", "latent", "depth", "photo")}
    else:
        paths = {kind: run.folder / "lit" / f"{kind}.png" for kind in ("warps", "patches", "fused", "latent")}
    return {kind: path for kind, path in paths.items() if path.is_file()}


def picture(run: Run, kind: str) -> np.ndarray:
    """One of a run's pictures, ``[H, W, 3]`` bytes.

    Raises:
        CTMError: the file is missing, or no picture.
    """
    path = pictures(run).get(kind)
    if path is None:
        raise CheckpointError(run.folder, f"no picture of the {kind}", "those that runs write into lit/")
    return to_8_bits(read_image(path))[..., :3].numpy()


def pairs(runs: Sequence[Run]) -> list[tuple[Run, Run]]:
    """For each scene, backbone and appearance, a run without CTM and one with it that differ in nothing else.

    Of several, the first common seed, and the CTM closest to its preset, with all terms and the paper's sizes.
    """
    pairs_by_key: dict[tuple, tuple[Run, Run]] = {}
    for on in sorted((run for run in runs if run.setting["ctm"] != "off"), key=_distance):
        s = on.setting
        for off in (run for run in runs if run.setting["ctm"] == "off" and s["color_space"] == "rgb"):
            if (off.scene, off.seed) == (on.scene, on.seed) and differing(s, off.setting) == {"ctm"}:
                key = (on.scene, s["backbone"], s.get("backbone.encoding", ""), s["appearance"], s["loss"] is not None)
                pairs_by_key.setdefault(key, (off, on))
    return [pairs_by_key[key] for key in sorted(pairs_by_key)]


def _distance(run: Run) -> tuple[int, bool, bool, int]:
    """Sort key of a run with CTM: its differences from the preset, then its seed."""
    zeros = list(weights(run.setting).values()).count("0")
    return zeros, run.setting.get("ctm.P") != "4", run.setting.get("ctm.k") != "3", run.seed


def where_they_differ(first: np.ndarray, second: np.ndarray) -> tuple[slice, slice]:
    """The window, a quarter of the picture a side, in which two pictures, ``[H, W, 3]`` bytes, differ most.

    What differs everywhere, such as a dark background's tint, does not count: the median difference of each channel.
    """
    difference = first.astype(np.int16) - second
    difference = np.abs(difference - np.median(difference, axis=(0, 1)).astype(np.int16)).sum(-1, dtype=np.int64)
    height, width = (max(1, side // CROP_DIVISOR) for side in difference.shape)
    sums = np.pad(difference.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    windows = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    top, left = np.unravel_index(int(windows.argmax()), windows.shape)
    return slice(int(top), int(top) + height), slice(int(left), int(left) + width)
