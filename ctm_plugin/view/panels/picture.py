"""Which run, which picture of it, and what stands next to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
import viser

from ctm_plugin.color.light import MOST_STOPS
from ctm_plugin.runs.load import KINDS
from ctm_plugin.scene.views import Scene
from ctm_plugin.show.pictures import depth_picture
from ctm_plugin.view.look import LAYOUTS

LABELS = dict(zip(KINDS, ("lit", "dark", "latent", "depth"), strict=True))
NOTHING, PHOTOGRAPH = "nothing", "photograph"


class PicturePanel:
    """Controls of what is shown of the runs.

    Args:
        gui: a client's.
        runs: their names.
        scene: of all of them.
        stops: where the light begins.
        changed: called when something else is to be shown.
    """

    def __init__(self, gui: viser.GuiApi, runs: Sequence[str], scene: Scene, stops: float, changed: Callable):
        beside = (NOTHING, *(runs if len(runs) > 1 else ()), PHOTOGRAPH)
        self._run = gui.add_dropdown("run", tuple(runs), visible=len(runs) > 1)
        self._kind = gui.add_dropdown("picture", tuple(LABELS.values()), initial_value=LABELS["lit"])
        self._legend = gui.add_image(legend(scene), label=legend_label(scene), format="png", visible=False)
        self._stops = gui.add_slider(
            "light, stops", -MOST_STOPS, MOST_STOPS, 0.1, round(stops, 1), hint="of lit pictures: 1 doubles it"
        )
        self._beside = gui.add_dropdown("next to it", beside, initial_value=runs[1] if len(runs) > 1 else NOTHING)
        self._layout = gui.add_dropdown("compare by", LAYOUTS)
        self._split = gui.add_slider("left part", 0.0, 1.0, 0.01, 0.5, hint="how much of the width is the run's")
        for control in (self._run, self._kind, self._stops, self._beside, self._layout, self._split):
            control.on_update(changed)
        self.arrange()

    def arrange(self) -> None:
        """Show the controls that mean something now."""
        self._legend.visible = self.kind == "depth"
        self._layout.visible = self.beside != NOTHING
        self._split.visible = self.beside != NOTHING and self.layout == "slider"

    @property
    def run(self) -> str:
        return self._run.value

    @property
    def kind(self) -> str:
        return next(key for key, label in LABELS.items() if label == self._kind.value)

    @property
    def factor(self) -> float:
        return 2.0 ** min(max(self._stops.value, -MOST_STOPS), MOST_STOPS)

    @property
    def beside(self) -> str:
        """A run's name, or one of ``NOTHING`` and ``PHOTOGRAPH``."""
        return self._beside.value

    @property
    def layout(self) -> str:
        return self._layout.value

    @property
    def split(self) -> float:
        return self._split.value


def legend(scene: Scene) -> np.ndarray:
    """The colours of depths from near to far, bytes ``[16, 256, 3]``."""
    depths = torch.linspace(scene.near, scene.far, 256).expand(16, 256)
    return (depth_picture(depths, scene.near, scene.far) * 255).round().byte().numpy()


def legend_label(scene: Scene) -> str:
    return f"depth, from {scene.near:.4g} to {scene.far:.4g}"
