"""The seam between a field and the colours it is trained on.

A field renders a *latent* of ``channels`` numbers a ray. A :class:`ColorTransform` says what these mean: it encodes the
training colours, decodes what was rendered, and gives the loss terms that compare the two. A field trained through this
seam never knows which transform it has, the identity included.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from operator import add
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.settings import TransformTraining
from ctm_plugin.errors import CTMError
from ctm_plugin.settings.setting import Nothing

Uniform = Callable[[int, int], Tensor]
"""``uniform(rows, channels)``: a ``[rows, channels]`` float32 tensor of draws from U[0, 1]."""

Ends = tuple[float | Tensor, float | Tensor]
"""Lowest and highest latent of a range, ``[]`` each."""


class ColorLoss(NamedTuple):
    """Weighted loss terms by name, and the encoded training colours they compare with (detached)."""

    terms: dict[str, Tensor]
    target: Tensor


class ColorTransform(nn.Module):
    """Base of all colour transforms: ``encode: [0,1]^3 -> [0,1]^k``, ``decode: [0,1]^k -> [0,1]^3``, a pixel at a time.

    Args:
        config: its settings, a ``Config``; the defaults if there are none.

    Attributes:
        channels: k, the number of latent channels the field has to render.
        label: how the command line chose it, for messages.
        learning: how it is trained, where it has parameters.
        filled: lowest and highest latent of the scene's colours; random backgrounds behind pictures and renderings
            are drawn from that range.
    """

    Config: type = Nothing
    channels: int = 3
    filled: Ends = (0.0, 1.0)
    label: str = "colour transform"
    learning: TransformTraining = TransformTraining()

    def __init__(self, config: Any = None):
        super().__init__()
        self.config = self.Config() if config is None else config

    @property
    def behind(self) -> Ends:
        """Lowest and highest latent of random backgrounds that lie behind renderings only."""
        return self.filled

    def begin(self, rgb: Float[Tensor, "n 3"]) -> None:
        """Fit the transform to some of the scene's training colours, once, before anything is trained. Most have
        nothing to fit.

        The fit goes into buffers (``register_buffer``): checkpoints hold them, so that a resumed or rendered run is
        not fitted again.
        """

    def describe(self) -> str | None:
        """Summary of the fit in a few words; ``None`` where nothing is fitted."""
        return None

    def encode(self, rgb: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n k"]:
        """RGB in [0, 1] to latent in [0, 1]."""
        raise NotImplementedError

    def decode(self, latent: Float[Tensor, "*n k"]) -> Float[Tensor, "*n 3"]:
        """Latent in [0, 1] to RGB in [0, 1]."""
        raise NotImplementedError

    def losses(
        self,
        latents: Sequence[Float[Tensor, "r k"]],
        rgb: Float[Tensor, "r 3"],
        photometric: Photometric,
        uniform: Uniform,
    ) -> ColorLoss:
        """Loss terms of one batch.

        Args:
            latents: one or more renderings of the same rays (NeRF gives its coarse and its fine one).
            rgb: the training colours of these rays.
            photometric: the distance, with its weight.
            uniform: source of random numbers; transforms draw from nothing else.

        Returns:
            Terms already weighted, to be summed. Here ``color``: the plain loss in the encoded space, Eq. 3.
        """
        target = self.encode(rgb).detach()
        return ColorLoss({"color": reduce(add, (photometric(latent, target) for latent in latents))}, target)

    def cycle_loss(self, rgb: Float[Tensor, "r 3"], uniform: Uniform) -> Tensor:
        """Loss of pre-training on colours, without a field: ``[]``, 0 for fixed transforms."""
        return rgb.new_zeros(())


class Chain(ColorTransform):
    """``inner`` on top of ``outer``: encode = inner o outer, decode = outer^-1 o inner^-1.

    The inner transform takes the outer space for its RGB, so that its losses compare colours of the outer space.
    """

    def __init__(self, outer: ColorTransform, inner: ColorTransform):
        super().__init__()
        self.outer = outer
        self.inner = inner
        self.channels, self.label, self.learning = inner.channels, inner.label, inner.learning

    def begin(self, rgb: Tensor) -> None:
        self.inner.begin(fitted(self.outer, rgb))

    filled = property(lambda self: self.inner.filled)
    behind = property(lambda self: self.inner.behind)

    def describe(self) -> str | None:
        return self.outer.describe()

    def encode(self, rgb: Tensor) -> Tensor:
        return self.inner.encode(self.outer.encode(rgb))

    def decode(self, latent: Tensor) -> Tensor:
        return self.outer.decode(self.inner.decode(latent))

    def losses(self, latents: Sequence[Tensor], rgb: Tensor, photometric: Photometric, uniform: Uniform) -> ColorLoss:
        return self.inner.losses(latents, self.outer.encode(rgb), photometric, uniform)

    def cycle_loss(self, rgb: Tensor, uniform: Uniform) -> Tensor:
        return self.inner.cycle_loss(self.outer.encode(rgb), uniform)


@torch.no_grad()
def fitted(transform: ColorTransform, rgb: Float[Tensor, "n 3"]) -> Float[Tensor, "n k"]:
    """Fit a transform to a scene's colours (:meth:`~ColorTransform.begin`), and give these colours encoded by it.

    Raises:
        CTMError: the encoded colours do not have the transform's ``channels``, or are not finite.
    """
    transform.begin(rgb)
    latent = transform.encode(rgb)
    _check(transform, "encoded", latent, (len(rgb), transform.channels))
    _check(transform, "decoded again", transform.decode(latent), (len(rgb), 3))
    return latent


def _check(transform: ColorTransform, done: str, values: Tensor, shape: tuple[int, int]) -> None:
    fault = f"{transform.label}: found the scene's colours {done}"
    if values.shape != shape:
        raise CTMError(f"{fault} as {list(values.shape)}, expected {list(shape)} for its {transform.channels} channels")
    if not values.isfinite().all():
        raise CTMError(f"{fault} with NaN or infinity, expected numbers in [0, 1]")
