"""Shaken pictures among sharp ones; of sharp captures none is left out."""

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d

from ctm_plugin.cameras.photographs import below
from ctm_plugin.cameras.search import read_light
from ctm_plugin.cameras.settings import CamerasConfig
from ctm_plugin.cameras.sharpness import unsharp
from ctm_plugin.data.readers.folders import is_picture
from ctm_plugin.data.readers.images import read_picture


def scenes(count: int = 9) -> list[np.ndarray]:
    """Light of one wall of dots, each picture moved by a few pixels."""
    wall = np.random.default_rng(0).random((48, 100), np.float32) ** 4
    return [wall[:, number : number + 64] for number in range(count)]


def shaken(light: np.ndarray) -> np.ndarray:
    return uniform_filter1d(light, 9, axis=1)


def test_shaken_ones_are_found():
    lights = scenes()
    assert unsharp(lights, [0] * 9) == []
    for number in (0, 4, 5):
        lights[number] = shaken(lights[number])
    assert unsharp(lights, [0] * 9) == [0, 4, 5]


def test_light_and_noise_are_no_blur():
    """A tenth of the light has a hundredth of the variance; noise has more than its share."""
    rng, lights = np.random.default_rng(1), scenes()
    lights[4] = lights[4] / 10
    assert unsharp(lights, [0] * 9) == []
    noisy = [light / 10 + rng.normal(0, 0.1, light.shape).astype(np.float32) for light in lights]
    noisy[4] = scenes()[4]
    assert unsharp(noisy, [0] * 9) == []


def test_only_pictures_of_one_sensor_are_compared():
    lights = [shaken(light) if number % 2 else light for number, light in enumerate(scenes(18))]
    assert unsharp(lights, ["one", "other"] * 9) == []


@pytest.mark.slow
@pytest.mark.parametrize("capture", ["lom/bike/low", "fern/images_8", "lego_400/train", "realx3d/MilkCookie/train"])
def test_sharp_captures_lose_none(ctm_data, capture):
    paths = [path for path in below(ctm_data / capture) if is_picture(path)]
    lights = [read_light(read_picture(path), CamerasConfig().size).light.numpy() for path in paths]
    assert unsharp(lights, [light.shape for light in lights]) == []
