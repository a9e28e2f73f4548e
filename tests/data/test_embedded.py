"""The scenes inside the package: a still life and a forward-facing room, each lit and dark."""

import json

import pytest
import torch

from ctm_plugin.data.embedded import ASSETS, StillLifeConfig, WhiteRoomConfig
from ctm_plugin.errors import ConfigError
from ctm_plugin.scene.views import Scene

CONFIGS = {"still_life": StillLifeConfig, "white_room": WhiteRoomConfig}
KINDS = {
    "still_life": ("bounded", "random_matched", (100, 128, 128, 4), 25, ("r_0", "r_1")),
    "white_room": ("forward", "random", (42, 128, 128, 3), 7, ("view_000", "view_008")),
}


@pytest.fixture(scope="module", params=CONFIGS)
def name(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def lit(name) -> Scene:
    return CONFIGS[name](light="lit").load()


@pytest.fixture(scope="module")
def dark(name) -> Scene:
    return CONFIGS[name]().load()


def light(name: str) -> float:
    return json.loads((ASSETS / name / "dark" / "settings.json").read_text())["light"]


def test_what_is_inside(name, lit, dark):
    geometry, background, shape, count, names = KINDS[name]
    for scene in (lit, dark):
        assert (scene.geometry, scene.background) == (geometry, background)
        assert scene.train.images.shape == shape
        assert scene.test.images.shape == (count, *shape[1:])
        assert scene.test.depth.shape == (count, 128, 128)
        assert scene.train.depth is None
        assert scene.test.names[:2] == names
    assert (lit.name, dark.name) == (f"{name}_lit", f"{name}_dark")
    assert (lit.exposure, dark.exposure) == (1.0, light(name))
    assert (lit.dark, dark.dark) == (False, True)
    assert CONFIGS[name](exposure=0.5).load().exposure == pytest.approx(0.5 * light(name))
    shrunk = CONFIGS[name](downscale=4, skip=6).load()
    assert shrunk.train.images.shape[:3] == (-(-shape[0] // 6), 32, 32)
    assert shrunk.test.depth.shape == (count, 32, 32)


def test_both_lights_show_the_same_views(lit, dark):
    assert torch.equal(lit.train.c2w, dark.train.c2w)
    assert torch.equal(lit.test.depth.isnan(), dark.test.depth.isnan())
    assert (lit.near, lit.far) == (dark.near, dark.far)


def test_dimmed_by_exposure_as_rendered_in_weak_light(name, dark):
    """Apart from rounding only the noise and the denoiser differ: in 95 % of the room's pixels by one grey level."""
    dimmed = CONFIGS[name](light="lit", exposure=light(name)).load()
    off = (dimmed.test.images.int() - dark.test.images.int()).abs()
    if name == "white_room":
        assert (off.amax(dim=-1) <= 1).flatten(1).float().mean(dim=1).min() >= 0.95
    else:
        opaque = (dimmed.test.images[..., 3] == 255) & (dark.test.images[..., 3] == 255)
        assert off[..., :3][opaque].float().mean() < 1.0


def test_settings_are_checked(name):
    with pytest.raises(ConfigError, match=r"dataset\.light: found 'dusk', expected one of dark, lit"):
        CONFIGS[name](light="dusk")
    with pytest.raises(ConfigError, match=r"dataset\.downscale: found 300, expected at most a side of the pictures"):
        CONFIGS[name](downscale=300).load()
