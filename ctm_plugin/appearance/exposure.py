"""One exposure a picture; the base of all appearances: parameters of each picture that act on linear light."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.optim import Adam, Optimizer

from ctm_plugin.appearance.settings import ExposureConfig
from ctm_plugin.color.srgb import srgb_to_linear
from ctm_plugin.errors import ConfigError
from ctm_plugin.optim.schedules import Schedule, exponential
from ctm_plugin.scene.views import Views, unit

MIN_MEAN_LIGHT = 1e-6
"""Least mean linear light of a picture from which its initial exposure is taken."""


class PixelPlaces(NamedTuple):
    """Places of R pixels in training pictures, and the colours rendered there."""

    view: Int[Tensor, " r"]
    """Index of each pixel's training picture."""
    at: Float[Tensor, "r 2"]
    """Position in the picture: x to the right and y down, each from 0 to 1."""
    rendered: Float[Tensor, "r 3"]
    """sRGB that the field renders at the pixel, without gradient."""


class Exposure(nn.Module):
    """An exposure of each picture's own: a gain on linear light, ``y = g_i x`` in picture i.

    Gains are ``g_i = exp(a_i - mean_j a_j)``: their logarithms add up to 0 whatever is learned, so that the scene keeps
    the brightness of its pictures' geometric mean, which a field, or a colour transform, could otherwise trade for it.

    Args:
        config: its settings, a ``Config``.
        views: the training pictures.

    Raises:
        ConfigError: exposures are to start from EXIF, which some picture does not have.
    """

    Config: type = ExposureConfig

    def __init__(self, config: ExposureConfig, views: Views):
        super().__init__()
        self.config = config
        start = log_exposures(config.start, views)
        if config.fixed:
            self.register_buffer("log_gain", start)
        else:
            self.log_gain = nn.Parameter(start)

    def log_gains(self) -> Float[Tensor, " n"]:
        """Natural logarithms of all pictures' gains; their mean is 0."""
        return self.log_gain - self.log_gain.mean()

    def forward(self, light: Float[Tensor, "r 3"], place: PixelPlaces) -> Float[Tensor, "r 3"]:
        """Apply the appearance: the field's linear light as the pictures recorded it, before clipping."""
        return light * self.log_gains().exp().index_select(0, place.view)[:, None]

    def undone(self, light: Float[Tensor, "r 3"], place: PixelPlaces) -> Float[Tensor, "r 3"]:
        """Undo the appearance: the pictures' linear light as the field has it."""
        return light / self.log_gains().exp().index_select(0, place.view)[:, None]

    def regularisers(self) -> dict[str, Tensor]:
        """Weighted loss terms by name, ``[]`` each, that regularise the appearance's parameters."""
        return {}

    def optimizer(self, steps: int) -> tuple[Optimizer, Schedule] | None:
        """The appearance's optimizer and its schedule over ``steps``; ``None``: nothing is learned."""
        groups = self.groups()
        return (Adam(groups), exponential(self.config.lr_decay, steps)) if groups else None

    def groups(self) -> list[dict]:
        """Adam's parameter groups of the appearance, each with its name and learning rate."""
        return [] if self.config.fixed else [{"params": [self.log_gain], "lr": self.config.lr, "name": "exposure"}]

    @torch.no_grad()
    def describe(self) -> str:
        """Summary of the learned appearance in a few words, for messages."""
        low, high = (self.log_gains() / math.log(2)).aminmax()
        return f"exposures from {low:+.2f} to {high:+.2f} stops"


def log_exposures(start: str, views: Views) -> Float[Tensor, " n"]:
    """Natural logarithms of the pictures' exposures, up to one common offset.

    Args:
        start: ``same``, ``light`` or ``exif``. ``light`` takes the views' ``gains``; where a picture has none, the mean
            linear light of all pixels that count.
        views: the pictures.

    Raises:
        ConfigError: a picture's EXIF gives no exposure.
    """
    if start == "same":
        return torch.zeros(len(views))
    if start == "exif":
        exposures = torch.full((len(views),), torch.nan) if views.exposures is None else views.exposures
        if silent := [name for name, missing in zip(views.names, exposures.isnan().tolist(), strict=True) if missing]:
            expected = f"pictures whose EXIF has an exposure time: {len(silent)} of {len(views)} have none"
            raise ConfigError("appearance.start", start, f"{expected}, as {silent[0]}")
        return exposures.log()
    gains, means = views.gains, []
    if gains is not None and gains.isfinite().all():
        return gains
    for index, image in enumerate(views.images):
        pixels = image if views.mask is None else image[views.mask[index]]
        pixels = pixels[pixels[..., 3] > 0] if views.has_alpha else pixels
        means.append(srgb_to_linear(unit(pixels[..., :3])).mean() if len(pixels) else torch.tensor(MIN_MEAN_LIGHT))
    light = torch.stack(means).float().cpu().clamp(min=MIN_MEAN_LIGHT).log()
    return light if gains is None else gains.where(gains.isfinite(), light + (gains - light).nanmedian())
