"""The white room inside the package is whole, and its light and depth mean what docs/scenes.md says."""

import json
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from ctm_plugin import data
from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.scenes import SCENES
from ctm_plugin.scenes.encode import decode_depth
from ctm_plugin.scenes.layouts import axial_bounds, write_poses_bounds

ASSETS = Path(data.__file__).parent / "assets" / "white_room"
SCENE = SCENES["white_room"]
COUNT, SIZE = 49, 128
LIGHTS = ("lit", "dark")


def settings(light: str) -> dict:
    return json.loads((ASSETS / light / "settings.json").read_text())


def pictures(light: str) -> np.ndarray:
    """``[49, H, W, 3]``."""
    return np.stack([iio.imread(ASSETS / light / f"images/view_{i:03d}.png") for i in range(COUNT)])


@pytest.fixture(scope="module")
def taken() -> dict[str, np.ndarray]:
    return {light: pictures(light) for light in LIGHTS}


@pytest.fixture(scope="module")
def depth() -> np.ndarray:
    """``[49, H, W]`` distance along the ray, NaN for nothing."""
    codes = [iio.imread(ASSETS / f"lit/depth/view_{i:03d}.png") for i in range(COUNT)]
    return decode_depth(np.stack(codes), settings("lit")["depth_scale"])


@pytest.mark.parametrize("light", LIGHTS)
def test_views_are_whole(taken, light):
    assert taken[light].dtype == np.uint8
    assert taken[light].shape == (COUNT, SIZE, SIZE, 3)


@pytest.mark.parametrize("light", LIGHTS)
def test_cameras_are_the_scene_s(tmp_path, depth, light):
    bounds = np.array([axial_bounds(view, SCENE.camera_angle_x) for view in depth])
    write_poses_bounds(tmp_path, SCENE.train(COUNT, 0), SCENE.camera_angle_x, (SIZE, SIZE), bounds)
    found, expected = (np.load(folder / "poses_bounds.npy") for folder in (ASSETS / light, tmp_path))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_settings_differ_in_light_alone():
    lit, dark = (settings(light) for light in LIGHTS)
    assert {key for key in lit if lit[key] != dark[key]} == {"light"}
    assert (lit["light"], dark["light"]) == (1.0, 0.02)


def test_lit_is_well_exposed(taken):
    for view in taken["lit"]:
        assert 130 < np.median(view) < 180
        assert 220 < np.percentile(view, 99) < 250
        assert (view.max(axis=-1) == 255).mean() < 0.01


def test_dark_is_lit_with_less_light(taken):
    """What ``dataset.exposure`` makes of the lit pictures is what the renderer makes under less light."""
    light = settings("dark")["light"] * srgb_to_linear(torch.from_numpy(taken["lit"] / 255.0))
    expected = np.rint(255.0 * linear_to_srgb(light).numpy())
    off = np.abs(expected - taken["dark"]).max(axis=-1)
    for view in off:
        assert (view <= 1.0).mean() >= 0.95
    assert np.percentile(taken["dark"], 99) < 40


def test_depth_is_the_same_in_both_lights():
    for index in range(COUNT):
        files = [ASSETS / light / f"depth/view_{index:03d}.png" for light in LIGHTS]
        assert files[0].read_bytes() == files[1].read_bytes()


def test_depth_is_inside_the_bounds(depth):
    """The room is closed: every ray hits something."""
    assert np.isfinite(depth).all()
    assert SCENE.near < depth.min() < depth.max() < SCENE.far


def rays() -> np.ndarray:
    """Unit directions ``[H, W, 3]`` of the pixels in the camera."""
    grid = (np.arange(SIZE) + 0.5 - 0.5 * SIZE) / (0.5 * SIZE / np.tan(0.5 * SCENE.camera_angle_x))
    x, y = np.meshgrid(grid, -grid)
    direction = np.stack([x, y, -np.ones_like(x)], axis=-1)
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def test_the_floor_is_flat_and_the_back_wall_plane(depth):
    """Points at the depth along the rays: the lowest lie at height 0, many of the farthest back at y = 1.4."""
    for pose, view in zip(SCENE.train(COUNT, 0), depth, strict=True):
        point = (rays() * view[..., None]) @ pose[:3, :3].T + pose[:3, 3]
        # Depth is exact to half a step; rays that graze a plane turn little of that into height.
        assert point[..., 2].min() == pytest.approx(0.0, abs=2e-4)
        assert (np.abs(point[..., 2]) < 2e-4).mean() > 0.1
        assert (np.abs(point[..., 1] - 1.4) < 2e-4).mean() > 0.2
