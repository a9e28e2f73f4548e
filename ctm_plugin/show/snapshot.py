"""Snapshot of a field in training: one small rendering, and its target."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from ctm_plugin.color.light import AS_IS, Light, enhancement_gain
from ctm_plugin.metrics.rendered import View
from ctm_plugin.metrics.table import METRICS
from ctm_plugin.show.pictures import beside, error_picture, latent_picture


@dataclass
class Snapshot:
    """Pictures ``[H, W, 3]`` and latents ``[..., k]`` of a field in training, by their tags in loggers, and scores by
    their names in :data:`METRICS`; on the CPU."""

    pictures: dict[str, Tensor] = field(default_factory=dict)
    latents: dict[str, Tensor] = field(default_factory=dict)
    scores: dict[str, float] = field(default_factory=dict)


def compared(
    render: Tensor, target: Tensor | None, latent: Tensor, exposure: float | None, light: Light,
    mask: Tensor | None = None,
) -> Snapshot:  # fmt: skip
    """Make the snapshot of a rendering and its target, for all backbones that render pictures.

    Args:
        render, target: sRGB ``[H, W, 3]`` in [0, 1]; ``None`` where it is not known.
        latent: ``[H, W, k]`` that ``render`` was decoded from.
        exposure: light relative to a normal exposure, ``None`` where it is not known.
        light: light in which the scene is displayed.
        mask: which pixels are scored, ``[H, W]``; ``None``: all are.

    Returns:
        Pictures ``test/render``, ``target``, ``error``, ``latent``, and where it is dark ``lit``, the rendering
        next to its target; latents ``latent/render``; the scores that have curves.
    """
    shown = Snapshot(latents={"latent/render": latent})
    both = [render] if target is None else [render, target]
    shown.pictures = {"test/render": render, "test/latent": latent_picture(latent)}
    if light != AS_IS:
        shown.pictures["test/lit"] = beside(*[light.apply(picture) for picture in both])
    if target is None:
        return shown
    shown.pictures["test/target"] = target
    shown.pictures["test/error"] = error_picture((render - target).abs().mean(-1), float(target.max()) / 4)
    gain = enhancement_gain([target], exposure)
    view = View(render, target, gain, mask=mask)
    for name, metric in METRICS.items():
        if metric.curve and (gain > 1 or not metric.dark):
            shown.scores[name] = metric.view(view)
    return shown
