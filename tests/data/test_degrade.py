"""Exposure and noise against closed forms and their own laws."""

import pytest
import torch
from hypothesis import strategies as st

from ctm_plugin.color.srgb import srgb_to_linear
from ctm_plugin.data.degrade import add_noise, view_generator
from ctm_plugin.data.settings import NoiseConfig

LEVELS = torch.arange(256, dtype=torch.float64) / 255.0
UNIT = st.floats(0.0, 1.0)
EXPOSURE = st.floats(1e-4, 1.0)


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_noise_variance_in_linear_light():
    noise = NoiseConfig(read=0.01, shot=0.002, seed=3)
    image = torch.full((200_000,), 0.6, dtype=torch.float64)
    light = srgb_to_linear(image)
    noisy = srgb_to_linear(add_noise(image, noise, view_generator(0, "a")))
    assert noisy.mean().item() == pytest.approx(light[0].item(), abs=3e-4)
    assert noisy.var().item() == pytest.approx((0.002 * light[0] + 0.01**2).item(), rel=0.02)


def test_noise_stays_in_range_and_off_is_the_identity():
    image = LEVELS.float()
    noisy = add_noise(image, NoiseConfig(read=1.0, shot=1.0), view_generator(0, "a"))
    assert noisy.min() >= 0.0
    assert noisy.max() <= 1.0
    assert add_noise(image, NoiseConfig(seed=5), view_generator(5, "a")) is image


def test_generators_depend_on_seed_and_name_alone():
    def draw(seed: int, name: str) -> torch.Tensor:
        return torch.randn(4, generator=view_generator(seed, name))

    assert torch.equal(draw(0, "r_1"), draw(0, "r_1"))
    assert not torch.equal(draw(0, "r_1"), draw(0, "r_2"))
    assert not torch.equal(draw(0, "r_1"), draw(1, "r_1"))
