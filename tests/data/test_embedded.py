"""The scenes inside the package: a still life and a forward-facing room, each lit and dark."""

import itertools
import json

import pytest
import torch
import torch.nn.functional as F

from ctm_plugin.data.embedded import ASSETS, StillLifeConfig, WhiteRoomConfig
from ctm_plugin.errors import ConfigError
from ctm_plugin.scene.views import Scene, Views

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


@pytest.mark.parametrize("downscale", [1, 4])
def test_depth_is_where_the_object_is(downscale):
    scene = StillLifeConfig(light="lit", downscale=downscale).load()
    alpha, hit = scene.test.images[..., 3], ~scene.test.depth.isnan()
    assert hit[alpha == 255].float().mean() > 0.99
    assert hit[alpha == 0].float().mean() < 0.01


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
    depth = lit.test.depth[~lit.test.depth.isnan()]
    assert lit.near < depth.min() < depth.max() < lit.far
    assert disagreement(lit.test, along_ray=True) < 0.001 * depth.median()
    assert disagreement(lit.test, along_ray=False) > 0.0015 * depth.median()


def test_settings_are_checked(name):
    with pytest.raises(ConfigError, match=r"dataset\.light: found 'dusk', expected one of dark, lit"):
        CONFIGS[name](light="dusk")
    with pytest.raises(ConfigError, match=r"dataset\.downscale: found 300, expected at most a side of the pictures"):
        CONFIGS[name](downscale=300).load()
