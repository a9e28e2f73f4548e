"""The paper's figures out of finished runs, as PNG and PDF.

``python docs/evidence/figures.py FIGURE RUNS... [out=NAME]`` draws figure 3 to 8, or C of appendix C, as NAME.png and
NAME.pdf, by default ``figure_FIGURE``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ctm_plugin.errors import CheckpointError, CTMError
from ctm_plugin.files import replacing
from ctm_plugin.report.labels import find_runs
from ctm_plugin.report.pairs import pairs, picture, pictures, where_they_differ
from ctm_plugin.report.runs import Run, weights
from ctm_plugin.report.tables import fits
from ctm_plugin.runs.load import load_run
from ctm_plugin.scene.views import composite, unit

Picture = np.ndarray
INCHES, MAX_ASPECT = 1.8, 4
"""Width of a picture in inches, and largest height of a row in such widths; a figure's size follows."""
PATCH_SIDE = 100
"""Side in pixels of appendix C's patch; an eighth of a picture that is smaller than eight patches."""
CROP_COLUMN = "crop"
"""Label of a crop of the pictures above it, where the first and the last differ most."""


class PictureGrid(NamedTuple):
    """A figure of pictures of several kinds, a row each, of some runs side by side."""

    columns: Callable[[Sequence[Run]], Mapping[str, Run]]
    kinds: tuple[str, ...]
    expected: str


def draw(name: str, runs: Sequence[Run], path: Path) -> list[Path]:
    """Draw a figure: the paper's number, or ``C`` of appendix C; ``path`` has no ending. The files that were written.

    Raises:
        CTMError: the runs do not hold what the figure shows; it is said what is missing.
    """
    if name not in (known := [*FIGURES, "4", "C"]):
        raise CTMError(f"figure: found {name}, expected one of {', '.join(sorted(known))}")
    figure = {"4": renders, "C": variances}.get(name, partial(compared, name))(runs)
    written = [path.with_name(path.name + ending) for ending in (".png", ".pdf")]
    for file in written:
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as beside:
            figure.savefig(beside, format=file.suffix[1:], dpi=200)
    return written


def compared(name: str, runs: Sequence[Run]) -> Figure:
    """Draw one of :data:`FIGURES`."""
    wanted = FIGURES[name]
    columns, kinds = wanted.columns(runs), wanted.kinds
    if len(columns) < 2:
        raise _missing(name, wanted.expected)
    rows = [[picture(run, kind) for run in columns.values()] for kind in kinds if kind != CROP_COLUMN]
    if CROP_COLUMN in kinds:
        if len(sizes := {each.shape[:2] for each in rows[0]}) > 1:
            raise CTMError(f"found pictures of sizes {sorted(sizes)}, expected one")
        window = where_they_differ(rows[0][0], rows[0][-1])
        rows.append([each[window] for each in rows[0]])
    figure = _grid(rows, list(columns), kinds if len(kinds) > 1 else [""])
    for axes in figure.axes[: len(columns)] if CROP_COLUMN in kinds else ():
        axes.add_patch(_frame(window))
    return figure


def without(term: str, runs: Sequence[Run]) -> Mapping[str, Run]:
    """Two runs of one scene, seed and setting: CTM trained without a term, and with all."""
    for run in runs:
        if run.setting["ctm"] != "off" and "0" not in weights(run.setting).values() and "latent" in pictures(run):
            wanted = run.setting | {f"ctm.weights.{term}": "0"}
            for other in runs:
                if (other.setting, other.scene, other.seed) == (wanted, run.scene, run.seed):
                    return {f"without L_{term}": other, "full": run}
    return {}


def spaces(runs: Sequence[Run]) -> Mapping[str, Run]:
    """Colour spaces, RGB first, and CTM."""
    seen = _first_scene(runs)
    plain = [run for run in seen if run.setting["ctm"] == "off" and run.setting["loss"] is None]
    chosen = {run.setting["color_space"]: run for run in plain}
    learned = [("CTM", run) for run in seen if fits(run.setting, {})]
    return dict([*sorted(chosen.items(), key=lambda item: item[0] != "rgb"), *learned[:1]])


def alignments(runs: Sequence[Run]) -> Mapping[str, Run]:
    """Alignments without CTM and with it, for each encoding."""
    members = [run for pair in pairs(runs) if "fused" in pictures(pair[0]) for run in pair]
    several = len({run.scene for run in members}) > 1
    names = (f"{run.setting['backbone.encoding']}{'' if run.setting['ctm'] == 'off' else ' w/ CTM'}" for run in members)
    return {f"{run.scene}\n{name}" if several else name: run for name, run in zip(names, members, strict=True)}


def channels(runs: Sequence[Run]) -> Mapping[str, Run]:
    """CTM with several numbers of latent channels, few first."""
    members = [run for run in _first_scene(runs) if "ctm.k" in run.setting and fits(run.setting | {"ctm.k": "3"}, {})]
    return {f"k = {run.setting['ctm.k']}": run for run in sorted(members, key=lambda run: int(run.setting["ctm.k"]))}


def _first_scene(runs: Sequence[Run]) -> list[Run]:
    """The runs with views of the first scene, backbone and seed."""
    seen = [(run, (run.scene, run.setting["backbone"], run.seed)) for run in runs if "lit" in pictures(run)]
    return [run for run, kind in seen if kind == seen[0][1]]


WITHOUT_TERM = "a run without the term {} and one with all, as of experiment=table4"
"""What a figure about a loss term needs."""
FIGURES = {
    "3": PictureGrid(partial(without, "img"), ("latent",), WITHOUT_TERM.format("img")),
    "5": PictureGrid(spaces, ("lit", CROP_COLUMN), "runs of two colour spaces with views, as of experiment=table2"),
    "6": PictureGrid(alignments, ("warps", "fused"), "runs of backbone=barf2d without CTM and with it"),
    "7": PictureGrid(partial(without, "rand"), ("lit", CROP_COLUMN), WITHOUT_TERM.format("rand")),
    "8": PictureGrid(
        channels, ("lit", "depth"), "runs with views of two numbers of latent channels, as of experiment=table5"
    ),
}
"""Figures of the paper by their number."""


def renders(runs: Sequence[Run]) -> Figure:
    """Figure 4: renders without CTM and with it, their lower right halves lit; depth below."""
    rows, titles = [], []
    for pair in (pair for pair in pairs(runs) if "depth" in pictures(pair[0])):
        rows += [[half_lit(run) for run in pair], [picture(run, "depth") for run in pair]]
        titles += [f"{pair[0].scene}\n{pair[0].setting['backbone']}", "depth"]
    if not rows:
        raise _missing("4", "a run without CTM and one with it, of one scene and seed")
    return _grid(rows, ["without CTM", "with CTM"], titles)


def half_lit(run: Run) -> Picture:
    """A render, below its diagonal as bright as an eye wants it (where the scene is dark)."""
    if "dark" not in pictures(run):
        return picture(run, "lit")
    plain, lit = picture(run, "dark"), picture(run, "lit")
    if lit.shape != plain.shape:
        raise CheckpointError(run.folder, "a lit picture of another size", "that of the dark one")
    height, width = plain.shape[:2]
    y, x = np.mgrid[:height, :width]
    return np.where((x / width > 1 - y / height)[..., None], lit, plain)


def variances(runs: Sequence[Run]) -> Figure:
    """Appendix C: variance of a test picture and of its plainest patch before and after encoding."""
    run = next((run for run in runs if run.setting["ctm"] != "off" and run.metrics.get("per_image")), None)
    if run is None:
        raise _missing("C", "a run of a scene with CTM")
    before, after, window, values = variance_table(run)
    figure = _grid([[before, after]], ["picture", "encoded"], [""])
    for index, axes in enumerate(figure.axes):
        axes.add_patch(_frame(window))
        axes.set_xlabel("\n".join(f"{what}: {both[index]:.1f}" for what, both in values.items()), fontsize=7)
    figure.suptitle("variance, 8-bit units", fontsize=8)
    return figure


def variance_table(run: Run) -> tuple[Picture, Picture, tuple[slice, slice], dict[str, tuple[float, float]]]:
    """The first test picture, its encoding, the plainest patch, and variances ``(before, after)``.

    The variance of a picture: the mean over its channels of each channel's variance over the pixels, of values in
    0..255. The patch is the one of least variance before encoding among those that the scene fills.
    """
    module = load_run(run.folder).module
    image = module.scene.test.images[0]
    opaque = unit(image)[..., 3].numpy() == 1 if image.shape[-1] == 4 else np.ones(image.shape[:2], bool)
    shown = composite(image, module.constant_background().cpu())
    with torch.no_grad():
        encoded = module.transform.encode(shown.to(module.device)).float().cpu()
    before, after = (255.0 * each.double().numpy() for each in (shown, encoded))
    height, width = before.shape[:2]
    side = max(1, min(PATCH_SIDE, height // 8, width // 8))
    corners = np.mgrid[: height - side + 1 : max(1, side // 4), : width - side + 1 : max(1, side // 4)]
    windows = [(slice(top, top + side), slice(left, left + side)) for top, left in corners.reshape(2, -1).T]
    filled = [window for window in windows if opaque[window].all()]
    if not filled:
        raise CTMError(f"{run.folder}: found no {side}x{side} patch that the scene fills, expected one")

    def variance(values: np.ndarray) -> float:
        return float(values.var(axis=(0, 1)).mean())

    window = min(filled, key=lambda each: variance(before[each]))
    values = {
        "picture": (variance(before), variance(after)),
        f"plainest {side}x{side} patch": (variance(before[window]), variance(after[window])),
    }
    padded = np.pad(after, ((0, 0), (0, 0), (0, 3)))[..., :3]
    return before.round().astype(np.uint8), padded.round().astype(np.uint8), window, values


def _frame(window: tuple[slice, slice]) -> Rectangle:
    rows, columns = window
    size = columns.stop - columns.start, rows.stop - rows.start
    return Rectangle((columns.start - 0.5, rows.start - 0.5), *size, fill=False, edgecolor="red", linewidth=0.8)


def _grid(rows: Sequence[Sequence[Picture]], columns: Sequence[str], titles: Sequence[str]) -> Figure:
    """Pictures in rows and columns with their names."""
    heights = [min(MAX_ASPECT, max(each.shape[0] / each.shape[1] for each in row)) for row in rows]
    figure = Figure(figsize=(INCHES * len(columns) + 0.5, INCHES * sum(heights) + 0.5), layout="constrained")
    axes = figure.subplots(len(rows), len(columns), squeeze=False, height_ratios=heights)
    for cell, shown in zip(axes.flat, (each for row in rows for each in row), strict=True):
        cell.imshow(shown, interpolation="nearest")
        cell.set(xticks=[], yticks=[])
    for cell, name in zip(axes[0], columns, strict=True):
        cell.set_title(name, fontsize=8, parse_math=False)
    for cell, title in zip(axes[:, 0], titles, strict=True):
        cell.set_ylabel(title, fontsize=8, parse_math=False)
    return figure


def _missing(figure: str, what: str) -> CTMError:
    return CTMError(f"figure={figure}: found nothing to show, expected {what}")


def main(arguments: Sequence[str]) -> None:
    """Draw a figure of the runs in some folders."""
    name, *folders = [each for each in arguments if not each.startswith("out=")]
    out = next((each.removeprefix("out=") for each in arguments if each.startswith("out=")), f"figure_{name}")
    found = find_runs([Path(each) for each in folders])
    for why in found.left_out:
        print(f"left out: {why}", file=sys.stderr)
    for path in draw(name, found.runs, Path(out)):
        print(f"written to {path}")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except CTMError as error:
        sys.exit(f"error: {error}")
