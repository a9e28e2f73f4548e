"""The data set inside the package is whole, and its light, alpha and depth mean what docs/scenes.md says."""

import itertools
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

ASSETS = Path(data.__file__).parent / "assets" / "still_life"
SCENE = SCENES["still_life"]
SIZE = 128
COUNTS = {"train": 100, "test": 25}


def read(light: str, split: str) -> tuple[dict, np.ndarray]:
    """Transforms and the pictures ``[N, H, W, 4]`` of one split."""
    content = json.loads((ASSETS / light / f"transforms_{split}.json").read_text())
    pictures = [iio.imread(ASSETS / light / f"{frame['file_path']}.png") for frame in content["frames"]]
    return content, np.stack(pictures)


@pytest.fixture(scope="module")
def data() -> dict[tuple[str, str], tuple[dict, np.ndarray]]:
    return {key: read(*key) for key in itertools.product(("lit", "dark"), COUNTS)}


def poses(content: dict) -> np.ndarray:
    return np.array([frame["transform_matrix"] for frame in content["frames"]])


def test_it_is_small():
    assert sum(path.stat().st_size for path in ASSETS.rglob("*") if path.is_file()) <= 6_000_000


@pytest.mark.parametrize("light", ["lit", "dark"])
@pytest.mark.parametrize("split", COUNTS)
def test_views_are_whole(data, light, split):
    content, pictures = data[light, split]
    assert pictures.dtype == np.uint8
    assert pictures.shape == (COUNTS[split], SIZE, SIZE, 4)
    assert (content["camera_angle_x"], content["near"], content["far"]) == (SCENE.camera_angle_x, SCENE.near, SCENE.far)
    expected = getattr(SCENE, split)(COUNTS[split], 0)
    np.testing.assert_allclose(poses(content), expected, atol=1e-12)


@pytest.mark.parametrize("split", COUNTS)
def test_rotations_are_orthonormal(data, split):
    rotation = poses(data["lit", split][0])[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ rotation.transpose(0, 2, 1), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)


def test_no_test_view_is_a_training_view(data):
    train, test = (poses(data["lit", split][0])[:, :3, 3] for split in ("train", "test"))
    cosine = (test @ train.T) / np.linalg.norm(test, axis=-1)[:, None] / np.linalg.norm(train, axis=-1)
    assert np.rad2deg(np.arccos(cosine.max())) > 0.3


@pytest.mark.parametrize("light", ["lit", "dark"])
@pytest.mark.parametrize("split", COUNTS)
def test_alpha_is_real(data, light, split):
    pictures = data[light, split][1]
    alpha = pictures[..., 3]
    assert not pictures[alpha == 0].any()
    for view in alpha:
        assert 0.15 < (view == 255).mean() < 0.6
        assert 0.35 < (view == 0).mean() < 0.85
        assert ((view > 0) & (view < 255)).mean() > 0.01
    # The scene is whole in every picture: nothing touches the border.
    assert not any(edge.any() for edge in (alpha[:, 0], alpha[:, -1], alpha[:, :, 0], alpha[:, :, -1]))


@pytest.mark.parametrize("split", COUNTS)
def test_lit_is_well_exposed(data, split):
    pictures = data["lit", split][1]
    for view in pictures:
        colour = view[view[..., 3] == 255][:, :3]
        low, middle, high = np.percentile(colour, [1, 50, 99])
        assert low < 70
        assert 85 < middle < 150
        assert 185 < high < 245
        assert (colour.max(axis=-1) == 255).mean() < 0.02


@pytest.mark.parametrize("split", COUNTS)
def test_dark_is_lit_with_less_light(data, split):
    light = json.loads((ASSETS / "dark" / "settings.json").read_text())["light"]
    lit, dark = data["lit", split][1], data["dark", split][1]
    np.testing.assert_array_equal(lit[..., 3], dark[..., 3])
    expected = np.rint(255.0 * linear_to_srgb(light * srgb_to_linear(torch.from_numpy(lit[..., :3] / 255.0))).numpy())
    off = np.abs(expected - dark[..., :3]).max(axis=-1)
    for view, foreground in zip(off, lit[..., 3] > 0, strict=True):
        assert (view[foreground] <= 1.0).mean() >= 0.95
    assert np.percentile(dark[lit[..., 3] == 255][:, :3], 99) < 40


def test_settings_differ_in_light_alone():
    lit, dark = (json.loads((ASSETS / light / "settings.json").read_text()) for light in ("lit", "dark"))
    assert {key for key in lit if lit[key] != dark[key]} == {"light"}
    assert lit["light"] == 1.0
    assert lit["width"] == lit["height"] == SIZE
    assert {split: lit[key] for split, key in (("train", "views"), ("test", "test_views"))} == COUNTS


@pytest.fixture(scope="module")
def depth(data) -> np.ndarray:
    """``[25, H, W]`` distance along the ray, NaN for nothing."""
    content = data["lit", "test"][0]
    codes = [iio.imread(ASSETS / "lit" / frame["depth_file_path"]) for frame in content["frames"]]
    return decode_depth(np.stack(codes), content["depth_scale"])


def test_depth_is_the_same_in_both_lights():
    for index in range(COUNTS["test"]):
        files = [ASSETS / light / f"test/r_{index}_depth.png" for light in ("lit", "dark")]
        assert files[0].read_bytes() == files[1].read_bytes()


def test_depth_is_inside_the_bounds_and_under_the_alpha(data, depth):
    assert np.nanmin(depth) > SCENE.near
    assert np.nanmax(depth) < SCENE.far
    alpha = data["lit", "test"][1][..., 3]
    assert np.isfinite(depth[alpha == 255]).mean() > 0.999
    assert np.isnan(depth[alpha == 0]).mean() > 0.999


def rays(content: dict) -> np.ndarray:
    """Unit directions ``[H, W, 3]`` of the pixels in the camera."""
    focal = 0.5 * SIZE / np.tan(0.5 * content["camera_angle_x"])
    grid = (np.arange(SIZE) + 0.5 - 0.5 * SIZE) / focal
    x, y = np.meshgrid(grid, -grid)
    direction = np.stack([x, y, -np.ones_like(x)], axis=-1)
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def test_surface_points_are_inside_the_sphere(data, depth):
    content = data["lit", "test"][0]
    for pose, view in zip(poses(content), depth, strict=True):
        points = (rays(content) * view[..., None])[np.isfinite(view)] @ pose[:3, :3].T + pose[:3, 3]
        assert np.linalg.norm(points, axis=-1).max() < 1.25


@pytest.mark.parametrize("step", [1, 3])
def test_depth_agrees_between_views(data, depth, step):
    """Surface points of one view, seen from another, lie on or behind what that view sees."""
    content = data["lit", "test"][0]
    focal = 0.5 * SIZE / np.tan(0.5 * content["camera_angle_x"])
    matrices = poses(content)
    gaps = []
    for here in range(len(matrices)):
        there = (here + step) % len(matrices)
        view = depth[here]
        points = (rays(content) * view[..., None])[np.isfinite(view)] @ matrices[here, :3, :3].T + matrices[here, :3, 3]
        points = (points - matrices[there, :3, 3]) @ matrices[there, :3, :3]
        column = np.floor(SIZE / 2 - focal * points[:, 0] / points[:, 2]).astype(int)
        row = np.floor(SIZE / 2 + focal * points[:, 1] / points[:, 2]).astype(int)
        gaps.append(np.linalg.norm(points, axis=-1) - depth[there, row, column])
    gap = np.concatenate(gaps)
    # Silhouettes fall into the neighbouring pixel, which may see nothing.
    assert np.isnan(gap).mean() < 0.03
    gap = gap[np.isfinite(gap)]
    assert (gap < -0.1).mean() < 0.03
    assert (np.abs(gap) < 0.03).mean() > 0.7
