"""Less light and sensor noise, as arithmetic on images: scenes shot in the dark are made from lit ones, not stored."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.errors import ConfigError
from ctm_plugin.settings.build import setting
from ctm_plugin.settings.check import Number, check_integer, check_number


@dataclass(frozen=True, kw_only=True)
class NoiseConfig:
    """Noise of a sensor, in linear light where 1 is full scale: ``variance = shot x light + read²``.

    Raises:
        ConfigError: a value is out of range.
    """

    read: Number = setting(
        0.0, "standard deviation of the noise that does not depend on the light, in linear light, 0 to 1"
    )
    shot: Number = setting(0.0, "variance of the photons' noise per unit of linear light, 0 to 1")
    seed: int = setting(0, "seed of the noise's random numbers")

    def __post_init__(self) -> None:
        check_number("dataset.noise.read", self.read, lambda v: 0 <= v <= 1, "a number from 0 to 1")
        check_number("dataset.noise.shot", self.shot, lambda v: 0 <= v <= 1, "a number from 0 to 1")
        check_integer("dataset.noise.seed", self.seed, 0)

    @property
    def off(self) -> bool:
        return self.read == 0 and self.shot == 0


@dataclass(frozen=True, kw_only=True)
class LightConfig:
    """How dark pictures are made of lit ones.

    Raises:
        ConfigError: a value is out of range, here and in the data sets' settings that derive from these.
    """

    exposure: Number = setting(1.0, "factor on the linear light of the pictures, in (0, 1]; 1: as photographed")
    noise: NoiseConfig = setting(NoiseConfig(), "noise of a sensor, added to training views (or patches)")

    def __post_init__(self) -> None:
        check_number("dataset.exposure", self.exposure, lambda v: 0 < v <= 1, "a number in (0, 1]")
        if not isinstance(self.noise, NoiseConfig):
            raise ConfigError("dataset.noise", self.noise, "read, shot and seed")


def dim(image: Tensor, exposure: float) -> Tensor:
    """The image under ``exposure`` times the light: light adds up linearly, so every lamp dimmed is the picture dimmed.

    ``[...]`` float sRGB in [0, 1], in and out; what an exposure takes above 1 is clipped.
    """
    return image if exposure == 1 else linear_to_srgb((srgb_to_linear(image) * exposure).clamp(max=1))


def add_noise(image: Tensor, noise: NoiseConfig, generator: torch.Generator) -> Tensor:
    """Gaussian sensor noise in linear light, ``variance = shot x light + read²``, clipped to what a sensor can hold.

    ``[...]`` float sRGB in [0, 1], in and out; the generator is on its device.
    """
    if noise.off:
        return image
    light = srgb_to_linear(image)
    deviation = torch.sqrt(noise.shot * light + noise.read**2)
    draw = torch.randn(light.shape, generator=generator, dtype=light.dtype, device=light.device)
    return linear_to_srgb((light + deviation * draw).clamp(0.0, 1.0))


def view_generator(seed: int, name: str) -> torch.Generator:
    """A generator that depends only on the seed and the view's name, not on the order of loading."""
    entropy = np.random.SeedSequence([seed, zlib.crc32(name.encode("utf-8", "surrogatepass"))])
    return torch.Generator().manual_seed(int(entropy.generate_state(1, np.uint64)[0]) >> 1)
