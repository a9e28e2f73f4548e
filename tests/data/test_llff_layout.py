"""LLFF's layout, as our renderer writes it and as people have it."""

import math

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from layouts import llff_layout

from ctm_plugin.data.llff import LLFFConfig
from ctm_plugin.errors import ConfigError, DataError
from ctm_plugin.rays.cameras import pixel_rays

SIZE = (24, 16)


@pytest.fixture
def room(tmp_path):
    return llff_layout(tmp_path / "room", SIZE)


def rows(room) -> np.ndarray:
    return np.load(room / "poses_bounds.npy")


def test_every_eighth_view_is_for_testing(room):
    scene = LLFFConfig(root=room).load()
    assert scene.test.names == ("view_000", "view_008")
    assert len(scene.train) == 9
    assert scene.geometry == "forward"
    assert LLFFConfig(root=room, test_every=5, skip=4).load().train.names == ("view_001", "view_006")


def test_depth_lies_on_the_wall(room):
    """Points at the true depth along the rays of two views lie in one plane; near and far hold them."""
    scene = LLFFConfig(root=room).load()
    views = scene.test
    pixel = torch.arange(len(views) * views.height * views.width)
    rays = pixel_rays(views.c2w, views.intrinsics, views.height, views.width, pixel)
    points = rays.origins + views.depth.flatten()[:, None] * rays.directions
    spread = torch.linalg.svdvals((points - points.mean(0)).double())
    assert spread[2] < 1e-4 * spread[1]
    assert scene.near < views.depth.min()
    assert views.depth.max() < scene.far
    # The nearest bound of all views lies at 1 / 0.75.
    assert -(points[:, 2]).max() > 1.0


def test_pictures_of_a_ready_made_size_shrink_further(room):
    (room / "images").rename(room / "images_8")
    assert LLFFConfig(root=room).load().train.width == 24  # as LLFF's public scenes are handed on
    scene = LLFFConfig(root=room, factor=8, downscale=2).load()
    assert scene.test.images.shape[1:3] == scene.test.depth.shape[1:] == (8, 12)
    with pytest.raises(DataError, match=r"found only images_8, expected images_4 \(dataset.factor=4\)"):
        LLFFConfig(root=room, factor=4).load()
    with pytest.raises(DataError, match=r"found only images_8, expected images \(dataset.factor=1\)"):
        LLFFConfig(root=room, factor=1).load()
    with pytest.raises(ConfigError, match=r"dataset\.factor: found 0, expected an integer >= 1"):
        LLFFConfig(root=room, factor=0)


def test_light_and_depth_codes_of_a_rendering(room):
    floats = LLFFConfig(root=room).load().test.depth
    (room / "settings.json").write_text('{"light": 0.02, "depth_scale": 0.001}')
    for path in sorted((room / "depth").iterdir()):
        iio.imwrite(path.with_suffix(".png"), np.rint(np.load(path) / 0.001).astype(np.uint16))
        path.unlink()
    scene = LLFFConfig(root=room, exposure=0.5).load()
    assert scene.exposure == pytest.approx(0.01)
    torch.testing.assert_close(scene.test.depth, floats, rtol=1e-3, atol=0)


def test_fern(ctm_data):
    """The numbers that its publishers give: 20 views of 504x378, focal length 3260.5 at 4032x3024."""
    scene = LLFFConfig(root=ctm_data / "fern", downscale=8).load()
    assert (len(scene.train), len(scene.test)) == (17, 3)
    assert scene.train.images.shape[1:] == (378, 504, 3)
    torch.testing.assert_close(scene.train.intrinsics[0, :2], torch.tensor([3260.526 / 8] * 2), rtol=1e-3, atol=0)
    assert scene.train.c2w[:, 2, 2].min() > math.cos(math.radians(15))
    assert 1.0 < scene.far < 20


@pytest.mark.parametrize("bad", [[math.nan] * 2, [0.0] * 2, [2.0, math.inf]])
def test_rows_without_bounds_are_left_out(room, bad):
    """Of pictures in which COLMAP saw no points."""
    array = rows(room)
    nearest = int(array[:, 15].argmin())
    array[nearest, 15:] = bad
    np.save(room / "poses_bounds.npy", array)
    with pytest.warns(UserWarning, match=f"bounds of rows {nearest} are left out: .*: dataset.near and dataset.far"):
        scene = LLFFConfig(root=room, geometry="bounded").load()
    assert scene.near == pytest.approx(0.9 * np.delete(array[:, 15], nearest).min())
    array[:, 15:] = bad
    np.save(room / "poses_bounds.npy", array)
    with pytest.warns(UserWarning, match="no near and far there"):
        LLFFConfig(root=room).load()


def test_one_far_beyond_all_others(room):
    """A few bad points would blow the voxels' box up; NDC has room for them."""
    given = LLFFConfig(root=room, geometry="bounded").load()
    forward = LLFFConfig(root=room).load()
    array = rows(room)
    times = 5000 / array[:, 16].max()
    array[array[:, 16].argmin(), 16] = 5000
    np.save(room / "poses_bounds.npy", array)
    with pytest.warns(UserWarning, match="are left out: they have no points, or a far beyond 5 times"):
        assert LLFFConfig(root=room, geometry="bounded").load().far == pytest.approx(given.far)
    assert LLFFConfig(root=room).load().far == pytest.approx(forward.far * times)


@pytest.mark.parametrize("without", [lambda rows: rows[:, :15], lambda rows: rows * ([1.0] * 15 + [0.0] * 2)])
def test_without_bounds(room, without):
    """They are derived from the cameras, or given; hidden files beside the pictures count as none."""
    (room / "images/._view_000.png").write_bytes(b"x")
    np.save(room / "poses_bounds.npy", without(rows(room)))
    with pytest.warns(UserWarning, match="no near and far there; .* are taken from where the cameras stand and look"):
        LLFFConfig(root=room).load()
    given = LLFFConfig(root=room, geometry="bounded", near=1, far=5).load()
    assert (given.near, given.far) == (1.0, 5.0)
