"""The pictures of docs/concepts.md, from runs on the still life: dark, in plain RGB, CTM and ctm=auto; lit, in CTM.

``python docs/pictures/concepts.py RUNS [FOLDER]``, with the runs of ``ctm -m ctm=off,quick,auto trainer=quick
hydra.sweep.dir=RUNS`` and ``ctm dataset.light=lit ctm=quick trainer=quick hydra.run.dir=RUNS/lit``.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import Tensor

from ctm_plugin.backbones.radiance import RadianceBackbone
from ctm_plugin.color.light import brighten
from ctm_plugin.draws import Draws
from ctm_plugin.report.labels import find_runs
from ctm_plugin.runs.load import load_run
from ctm_plugin.scene.views import composite
from ctm_plugin.show.pictures import depth_picture

COLORS = {"plain RGB": "off", "CTM": "quick", "ctm=auto": "auto"}
VIEW = 3
POINTS = 3000


class Shown:
    """A run: its field, its transform, and one test view of it."""

    def __init__(self, folder: Path):
        self.field: RadianceBackbone = load_run(folder).module.eval()
        self.ctm, self.scene = self.field.transform, self.field.scene
        self.photograph = composite(self.scene.test.images[VIEW], self.field.constant_background().cpu())
        self.view = {name: value.float().cpu() for name, value in self.field.render_view(self.scene.test, VIEW).items()}
        self.depth = depth_picture(self.view["depth"], self.scene.near, self.scene.far)

    def brightened(self, picture: Tensor) -> Tensor:
        return brighten(picture, 1 / self.scene.exposure, "hard") if self.scene.exposure else picture

    @torch.no_grad()
    def encode(self, colors: Tensor) -> Tensor:
        return self.ctm.encode(colors.to(self.field.device)).cpu()

    def colors(self) -> Tensor:
        """Some of the training colours, one a ray."""
        return self.field.scene_colors(Draws(0, 0, self.field.device), POINTS).cpu()


def bare(axis: plt.Axes, picture: Tensor, title: str) -> None:
    axis.imshow(picture.clamp(0, 1), interpolation="nearest")
    axis.set_title(title, fontsize=9)
    axis.axis("off")


def seam(run: Shown) -> plt.Figure:
    """What is encoded, what is rendered, what is decoded."""
    pictures = {
        "photograph C": run.photograph,
        "encoded, f(C)": run.encode(run.photograph),
        "rendered latent, F": run.view["latent"],
        "decoded, g(F)": run.view["rgb"],
    }
    figure, axes = plt.subplots(1, 4, figsize=(10, 2.6), gridspec_kw={"wspace": 0.35})
    for axis, (title, picture) in zip(axes, pictures.items(), strict=True):
        bare(axis, picture, title)
    for axis, label, style in zip(axes[:3], ("f", "compare", "g"), ("->", "<->", "->"), strict=True):
        ends = {"xy": (1.33, 0.5), "xytext": (1.02, 0.5), "xycoords": "axes fraction", "textcoords": "axes fraction"}
        axis.annotate("", **ends, arrowprops={"arrowstyle": style, "lw": 1.5})
        axis.text(1.175, 0.56, label, transform=axis.transAxes, ha="center", fontsize=8)
    return figure


def cubes(runs: dict[str, Shown]) -> plt.Figure:
    """The colours of each scene before encoding and after it, in the colours that they have in the light."""
    figure = plt.figure(figsize=(8, 6.2), layout="constrained")
    for row, (light, run) in enumerate(runs.items()):
        colors = run.colors()
        shown = run.brightened(colors[None])[0].numpy()
        for column, (title, points) in enumerate({"colours": colors, "encoded": run.encode(colors)}.items()):
            axis = figure.add_subplot(2, 2, 2 * row + column + 1, projection="3d")
            axis.scatter(*points.T, c=shown, s=3)
            axis.set(title=f"{light}: {title}", xlim=(0, 1), ylim=(0, 1), zlim=(0, 1))
            axis.set_box_aspect(None, zoom=0.9)
    return figure


def curves(runs: dict[str, Shown]) -> plt.Figure:
    """The encoding of grey, and where the scene's own colours lie."""
    figure, axes = plt.subplots(1, 2, figsize=(8, 3), sharey=True, layout="constrained")
    grey = torch.linspace(0, 1, 513)
    for axis, (light, run) in zip(axes, runs.items(), strict=True):
        low, high = np.percentile(run.colors().numpy(), (1, 99))
        axis.axvspan(low, high, color="0.88", label="98 % of the scene's colours")
        for channel, line in enumerate(run.encode(grey[:, None].expand(-1, 3)).T, start=1):
            axis.plot(grey, line, label=f"latent channel {channel}")
        axis.plot((0, 1), (0, 1), "k:", lw=0.8, label="no encoding")
        axis.set(title=light, xlabel="grey, sRGB", xlim=(0, 1), ylim=(0, 1))
    axes[0].set_ylabel("encoded")
    axes[1].legend(fontsize=7, loc="lower right")
    return figure


def gain(shown: dict[str, Shown]) -> plt.Figure:
    """One test view of the dark scene, brightened, and its depth, in each kind of colours."""
    figure, axes = plt.subplots(2, 4, figsize=(8.6, 4.5), layout="constrained")
    for column, (name, run) in enumerate(shown.items(), start=1):
        bare(axes[0, 0], run.brightened(run.photograph), "photograph")
        bare(axes[0, column], run.brightened(run.view["rgb"]), name)
        bare(axes[1, column], run.depth, f"depth, {name}")
    axes[1, 0].axis("off")
    return figure


def main(runs: Path, folder: Path) -> None:
    found = {(run.config["dataset"].get("light"), run.setting["ctm"]): run.folder for run in find_runs([runs]).runs}
    shown = {name: Shown(found["dark", ctm]) for name, ctm in COLORS.items()}
    on = {"dark": shown["CTM"], "lit": Shown(found["lit", "quick"])}
    folder.mkdir(parents=True, exist_ok=True)
    plt.switch_backend("agg")
    drawn = {"seam": seam(on["dark"]), "cubes": cubes(on), "curves": curves(on), "gain": gain(shown)}
    for name, figure in drawn.items():
        figure.savefig(folder / f"{name}.png", dpi=100, bbox_inches="tight", pil_kwargs={"optimize": True})
        plt.close(figure)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else Path(__file__).parent / "concepts")
