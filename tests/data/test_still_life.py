"""The scene inside the package."""

import itertools
import json

import pytest
import torch
import torch.nn.functional as F

from ctm_plugin.data.degrade import dim
from ctm_plugin.data.embedded import ASSETS, StillLifeConfig
from ctm_plugin.errors import ConfigError
from ctm_plugin.scene.views import Scene, Views


@pytest.fixture(scope="module")
def lit() -> Scene:
    return StillLifeConfig(light="lit").load()


@pytest.fixture(scope="module")
def dark() -> Scene:
    return StillLifeConfig().load()


@pytest.fixture(scope="module")
def light() -> float:
    return json.loads((ASSETS / "still_life" / "dark" / "settings.json").read_text())["light"]


def test_what_is_inside(lit, dark, light):
    for scene, name in ((lit, "still_life_lit"), (dark, "still_life_dark")):
        assert (scene.name, scene.geometry, scene.background) == (name, "bounded", "random_matched")
        assert scene.train.images.shape == (100, 128, 128, 4)
        assert scene.test.images.shape == (25, 128, 128, 4)
        assert scene.test.depth.shape == (25, 128, 128)
        assert scene.train.depth is None
    assert (lit.exposure, dark.exposure) == (1.0, light)
    assert (lit.dark, dark.dark) == (False, True)


def test_exposure_multiplies_the_rendered_light(light):
    assert StillLifeConfig(exposure=0.5).load().exposure == pytest.approx(0.5 * light)


def test_both_lights_show_the_same_views(lit, dark):
    assert torch.equal(lit.train.c2w, dark.train.c2w)
    assert torch.equal(lit.test.depth.isnan(), dark.test.depth.isnan())


def test_dark_is_lit_dimmed(lit, dark, light):
    opaque = (lit.test.images[..., 3] == 255) & (dark.test.images[..., 3] == 255)
    expected = dim(lit.test.images[..., :3][opaque].float() / 255.0, light) * 255.0
    off = (dark.test.images[..., :3][opaque].float() - expected).abs()
    # Apart from 8-bit rounding only the noise and the denoiser differ.
    assert off.mean() < 1.0


def test_depth_is_where_the_object_is(lit):
    for downscale in (1, 4):
        test = StillLifeConfig(light="lit", downscale=downscale).load().test
        alpha = test.images[..., 3]
        hit = ~test.depth.isnan()
        assert hit[alpha == 255].float().mean() > 0.99
        assert hit[alpha == 0].float().mean() < 0.01
        assert test.depth[hit].min() >= lit.near
        assert test.depth[hit].max() <= lit.far


def disagreement(test: Views, along_ray: bool) -> float:
    """Median difference between the surface points of each view and the surface its neighbour sees, in scene units."""
    size, (focal, _, centre, _) = test.width, test.intrinsics[0].tolist()
    y, x = torch.meshgrid(*(torch.arange(size) + 0.5,) * 2, indexing="ij")
    ray = torch.stack([(x - centre) / focal, (centre - y) / focal, -torch.ones_like(x)], dim=-1)
    if along_ray:
        ray = F.normalize(ray, dim=-1)
    off = []
    for a, b in itertools.pairwise(range(len(test))):
        points = (ray * test.depth[a][..., None])[~test.depth[a].isnan()] @ test.c2w[a, :, :3].T + test.c2w[a, :, 3]
        points = (points - test.c2w[b, :, 3]) @ test.c2w[b, :, :3]
        column, row = (-focal * points[:, i] / points[:, 2] / (size / 2) for i in (0, 1))
        place = torch.stack([column, -row], dim=-1)[None, None]
        found = F.grid_sample(test.depth[b][None, None], place, align_corners=False).flatten()
        off.append(found - (points.norm(dim=-1) if along_ray else -points[:, 2]))
    return torch.cat(off).abs().nanmedian().item()


def test_depth_is_the_distance_along_the_ray(lit):
    assert disagreement(lit.test, along_ray=True) < 0.001
    assert disagreement(lit.test, along_ray=False) > 0.006


def test_settings_are_checked():
    with pytest.raises(ConfigError, match=r"dataset\.light: found 'dusk', expected one of dark, lit"):
        StillLifeConfig(light="dusk")
    with pytest.raises(ConfigError, match=r"dataset\.exposure: found 0\.0"):
        StillLifeConfig(exposure=0.0)
    with pytest.raises(ConfigError, match=r"dataset\.downscale: found 300, expected at most a side of the pictures"):
        StillLifeConfig(downscale=300).load()
