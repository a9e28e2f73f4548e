"""The forward-facing scene inside the package."""

import json

import pytest
import torch

from ctm_plugin.data.embedded import ASSETS, WhiteRoomConfig
from ctm_plugin.errors import ConfigError
from ctm_plugin.rays.cameras import pixel_rays
from ctm_plugin.scene.views import Scene


@pytest.fixture(scope="module")
def lit() -> Scene:
    return WhiteRoomConfig(light="lit").load()


@pytest.fixture(scope="module")
def dark() -> Scene:
    return WhiteRoomConfig().load()


@pytest.fixture(scope="module")
def light() -> float:
    return json.loads((ASSETS / "white_room" / "dark" / "settings.json").read_text())["light"]


def test_what_is_inside(lit, dark, light):
    for scene, name in ((lit, "white_room_lit"), (dark, "white_room_dark")):
        assert (scene.name, scene.geometry, scene.background) == (name, "forward", "random")
        assert scene.train.images.shape == (42, 128, 128, 3)
        assert scene.test.images.shape == (7, 128, 128, 3)
        assert scene.test.depth.shape == (7, 128, 128)
        assert scene.train.depth is None
        assert scene.test.names[:2] == ("view_000", "view_008")
    assert (lit.exposure, dark.exposure) == (1.0, light)
    assert (lit.dark, dark.dark) == (False, True)


def test_exposure_multiplies_the_rendered_light(light):
    assert WhiteRoomConfig(exposure=0.5).load().exposure == pytest.approx(0.5 * light)


def test_both_lights_show_the_same_views(lit, dark):
    assert torch.equal(lit.train.c2w, dark.train.c2w)
    assert torch.equal(lit.test.depth, dark.test.depth)
    assert (lit.near, lit.far) == (dark.near, dark.far)


def test_dimmed_by_exposure_as_rendered_in_weak_light(dark, light):
    """``dataset.exposure`` on the lit pictures agrees with the rendering in 95 % of the pixels, to one grey level."""
    dimmed = WhiteRoomConfig(light="lit", exposure=light).load()
    for split in ("train", "test"):
        pair = [getattr(scene, split).images for scene in (dimmed, dark)]
        off = (pair[0].int() - pair[1].int()).abs().amax(dim=-1)
        assert (off <= 1).flatten(1).float().mean(dim=1).min() >= 0.95


def test_depth_agrees_between_views(lit):
    """Surface points of one view lie where the next view sees a surface, or behind it."""
    test = lit.test
    assert lit.near < test.depth.min() < test.depth.max() < lit.far
    rays = pixel_rays(test.c2w, test.intrinsics, 128, 128, torch.arange(128 * 128))
    points = rays.origins + test.depth[0].flatten()[:, None] * rays.directions
    points = (points - test.c2w[1, :, 3]) @ test.c2w[1, :, :3]
    focal, _, centre, _ = test.intrinsics[1].tolist()
    column = (centre - focal * points[:, 0] / points[:, 2]).floor().long()
    row = (centre + focal * points[:, 1] / points[:, 2]).floor().long()
    seen = (column >= 0) & (column < 128) & (row >= 0) & (row < 128)
    gap = points.norm(dim=-1)[seen] - test.depth[1, row[seen], column[seen]]
    assert seen.float().mean() > 0.7
    assert (gap.abs() < 0.02 * test.depth.max()).float().mean() > 0.9


def test_it_shrinks():
    shrunk = WhiteRoomConfig(downscale=4, skip=6).load()
    assert shrunk.train.images.shape == (7, 32, 32, 3)
    assert shrunk.test.depth.shape == (7, 32, 32)


def test_settings_are_checked():
    with pytest.raises(ConfigError, match=r"dataset\.light: found 'dusk', expected one of dark, lit"):
        WhiteRoomConfig(light="dusk")
    with pytest.raises(ConfigError, match=r"dataset\.background: found 'random_matched'"):
        WhiteRoomConfig(background="random_matched").load()
    with pytest.raises(ConfigError, match=r"dataset\.downscale: found 300, expected at most a side of the pictures"):
        WhiteRoomConfig(downscale=300).load()
