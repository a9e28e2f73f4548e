"""Less light and sensor noise, as arithmetic on images: scenes shot in the dark are made from lit ones, not stored."""

from __future__ import annotations

import zlib

import numpy as np
import torch
from torch import Tensor

from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.data.settings import NoiseConfig


def add_noise(image: Tensor, noise: NoiseConfig, generator: torch.Generator) -> Tensor:
    """Add Gaussian sensor noise in linear light, ``variance = shot x light + read²``, clipped to [0, 1].

    ``image`` and the result are ``[...]`` float sRGB in [0, 1]; the generator is on their device.
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
