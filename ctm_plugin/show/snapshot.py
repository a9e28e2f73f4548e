"""What a field looks like in the middle of its training: one small rendering, and what it should look like."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from ctm_plugin.color.srgb import enhancement_gain, lift
from ctm_plugin.metrics.rendered import View
from ctm_plugin.metrics.table import METRICS
from ctm_plugin.show.pictures import beside, error_picture, latent_picture


@dataclass
class Snapshot:
    """Pictures ``[H, W, 3]``, latents ``[..., k]`` and scores, by the names that loggers have for them; on the CPU."""

    pictures: dict[str, Tensor] = field(default_factory=dict)
    latents: dict[str, Tensor] = field(default_factory=dict)
    scores: dict[str, float] = field(default_factory=dict)


def compared(render: Tensor, target: Tensor, latent: Tensor, gain: float) -> Snapshot:
    """A rendering beside what it should be, as all backbones that render pictures show it.

    Args:
        render, target: sRGB ``[H, W, 3]`` in [0, 1].
        latent: ``[H, W, k]`` that ``render`` was decoded from.
        gain: turns up the light, see :func:`brightening`.

    Returns:
        Pictures ``test/render``, ``target``, ``error``, ``latent``, and where it is dark ``lifted``, the rendering
        beside its target; latents ``latent/render``; the scores that have curves.
    """
    shown = Snapshot(latents={"latent/render": latent})
    shown.pictures = {
        "test/render": render,
        "test/target": target,
        "test/error": error_picture((render - target).abs().mean(-1), float(target.max()) / 4),
        "test/latent": latent_picture(latent),
    }
    if gain > 1:
        shown.pictures["test/lifted"] = beside(lift(render, gain), lift(target, gain))
    view = View(render, target, gain)
    for metric in METRICS.values():
        if metric.curve and (gain > 1 or not metric.dark):
            shown.scores[metric.curve[0]] = metric.view(view)
    return shown


def brightening(target: Tensor, exposure: float | None) -> float:
    """By how much a picture's light is turned up: :func:`~ctm_plugin.color.srgb.enhancement_gain`, at least 1."""
    return max(enhancement_gain([target], exposure), 1.0)
