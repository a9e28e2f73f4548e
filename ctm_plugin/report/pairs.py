"""Pictures that runs have written, for reports and figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from ctm_plugin.color.light import brighten, factor_of
from ctm_plugin.data.readers.images import read_image, to_8_bits
from ctm_plugin.errors import CheckpointError
from ctm_plugin.report.apart import differing
from ctm_plugin.report.runs import Run
from ctm_plugin.runs.load import load_posed

KINDS = {"render": "", "lifted": "_lifted", "latent": "_latent", "depth": "_depth"}
"""Pictures of a view, by what stands behind the view's name."""
PHOTOGRAPHS = {"render": "_photo", "lifted": "_photo_lifted"}
"""The same of the photograph."""
ALIGNMENT = ("warps", "patches", "fused", "latent")
CROP = 4
"""A crop's sides are this part of the picture's."""


def view_name(run: Run) -> str | None:
    """The test view that is shown, the middle one; ``None`` for runs without views."""
    rows = run.metrics.get("per_image") or []
    return rows[len(rows) // 2]["name"] if rows else None


def pictures(run: Run) -> dict[str, Path]:
    """What there is of a run, by kind."""
    name = view_name(run)
    if name is None:
        paths = {kind: run.folder / "test" / f"{kind}.png" for kind in ALIGNMENT}
    else:
        paths = {kind: run.folder / "test" / f"{name}{end}.png" for kind, end in KINDS.items()}
    if name is not None and run.light != "auto":
        paths["lifted"] = paths["render"] if run.light != "off" else Path()
    return {kind: path for kind, path in paths.items() if path.is_file()}


def picture(run: Run, kind: str) -> np.ndarray:
    """One of a run's pictures, ``[H, W, 3]`` bytes.

    Raises:
        CTMError: it is missing, or no picture.
    """
    path = pictures(run).get(kind)
    if path is None:
        raise CheckpointError(run.folder, f"no picture of the {kind}", "those that runs write into test/")
    if kind == "lifted" and run.light != "auto":
        return lifted_anew(run)
    return to_8_bits(read_image(path))[..., :3].numpy()


def photograph(run: Run, kind: str) -> np.ndarray | None:
    """What a run's rendered or lifted view should be, ``[H, W, 3]`` bytes, where the run wrote it, else ``None``."""
    name, end = view_name(run), PHOTOGRAPHS.get(kind)
    again = kind == "lifted" and run.light != "auto"
    path = run.folder / "test" / f"{name}{PHOTOGRAPHS['render'] if again else end}.png"
    if name is None or end is None or kind not in pictures(run) or not path.is_file():
        return None
    levels = to_8_bits(read_image(path))[..., :3]
    if again:
        factor = factor_of(run.light, run.value("light_factor") or 1.0)
        levels = (brighten(levels.float() / 255, factor).clamp(0, 1) * 255).round().byte()
    return levels.numpy()


def lifted_anew(run: Run) -> np.ndarray:
    """The view that is shown, ``[H, W, 3]`` bytes, rendered again and brightened as ``run.light`` says.

    Its file has 8 bits, which would band.
    """
    posed = load_posed(run.folder)
    names = posed.module.scene.test.names
    with torch.no_grad():
        view = posed.module.render_view(posed.module.scene.test, names.index(view_name(run)))
    picture = posed.picture({"rgb": view["rgb"].float().cpu()}, "lifted", factor_of(run.light, posed.factor))
    return (picture.clamp(0, 1) * 255).round().byte().numpy()


def pairs(runs: Sequence[Run]) -> list[tuple[Run, Run]]:
    """For each scene, backbone and appearance a run without CTM and one with it, which differ in no more than that.

    The first seed that both have; CTM as its preset has it, all terms and the paper's sizes, where there is a choice.
    """
    found: dict[tuple, tuple[Run, Run]] = {}
    for on in sorted((run for run in runs if run.setting.ctm != "off"), key=_distance):
        s = on.setting
        for off in (run for run in runs if run.setting.ctm == "off" and s.color_space == "rgb"):
            if (off.scene, off.seed) == (on.scene, on.seed) and differing(s, off.setting) == {"ctm"}:
                key = (on.scene, s.backbone, s.encoding or "", s.appearance, s.loss != "mse")
                found.setdefault(key, (off, on))
    return [found[key] for key in sorted(found)]


def _distance(run: Run) -> tuple[int, bool, bool, int]:
    """How far a run with CTM is from its preset, and its seed."""
    return len(run.setting.without), run.setting.P != 4, run.setting.k != 3, run.seed


def where_they_differ(first: np.ndarray, second: np.ndarray) -> tuple[slice, slice]:
    """The window, a quarter of the picture a side, in which two pictures, ``[H, W, 3]`` bytes, differ most.

    What differs everywhere, such as a dark background's tint, does not count: the median difference of each channel.
    """
    difference = first.astype(np.int16) - second
    difference = np.abs(difference - np.median(difference, axis=(0, 1)).astype(np.int16)).sum(-1, dtype=np.int64)
    height, width = (max(1, side // CROP) for side in difference.shape)
    sums = np.pad(difference.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    windows = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    top, left = np.unravel_index(int(windows.argmax()), windows.shape)
    return slice(int(top), int(top) + height), slice(int(left), int(left) + width)
