"""What all layouts of photographs share: sizes, splits, bounds, geometry, and the settings that they refuse."""

import warnings

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from layouts import HOUSE, blender_layout, colmap_layout, llff_layout, room_poses, transforms_layout

from ctm_plugin.data.settings import NoiseConfig
from ctm_plugin.errors import ConfigError, DataError
from ctm_plugin.settings.registry import DATASETS

MAKE = {
    "blender": blender_layout,
    "transforms": lambda root: transforms_layout(root, room_poses(), **HOUSE),
    "colmap": lambda root: colmap_layout(root, room_poses()),
    "llff": lambda root: llff_layout(root, (24, 16)),
}
LISTED = ["transforms", "colmap", "llff"]
"""Those with a folder ``images``, in which every eighth picture is for testing."""


@pytest.fixture
def root(tmp_path, layout):
    return MAKE[layout](tmp_path / "set")


@pytest.fixture
def load(root, layout):
    def scene(**settings):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return DATASETS.get(layout)(**{"root": root, "geometry": "bounded"} | settings).load()

    return scene


@pytest.mark.parametrize("layout", MAKE)
def test_pictures_of_their_own_width(load):
    assert torch.equal(load(width="full").train.images, load().train.images)


@pytest.mark.parametrize("layout", MAKE)
@pytest.mark.parametrize("settings", [{"downscale": 2}, {"downscale": 1.4}, {"downscale": 3}, {"width": 5}])
def test_any_factor_and_width(load, settings):
    whole, small = load().test, load(**settings).test
    assert small.width == settings.get("width", round(whole.width / settings.get("downscale", 1)))
    across, down = small.width / whole.width, small.height / whole.height
    torch.testing.assert_close(small.intrinsics, whole.intrinsics * torch.tensor([across, down, across, down]))
    assert across == pytest.approx(down, abs=1 / whole.height)


@pytest.mark.parametrize("layout", LISTED)
def test_pictures_of_a_ready_made_size(load, root):
    shrunk = load(downscale=2)
    (root / "images_2").mkdir()
    for path in (root / "images").iterdir():
        iio.imwrite(root / "images_2" / path.name, np.full((shrunk.test.height, shrunk.test.width, 3), 77, np.uint8))
    ready = load(downscale=2)
    assert (ready.test.images == 77).all()
    torch.testing.assert_close(ready.test.intrinsics, shrunk.test.intrinsics)


@pytest.mark.parametrize("layout", MAKE)
def test_skip_and_noise_are_for_training(load):
    """The noise of a view does not depend on the others."""
    noise = NoiseConfig(read=0.05, seed=1)
    clean, noisy, thinned = load(), load(noise=noise), load(noise=noise, skip=2)
    assert thinned.train.names == clean.train.names[::2]
    assert len(load(skip=1000).train) == 1
    assert torch.equal(clean.test.images, thinned.test.images)
    assert torch.equal(noisy.train.images[::2], thinned.train.images)
    assert not torch.equal(clean.train.images, noisy.train.images)
    assert not torch.equal(noisy.train.images, load(noise=NoiseConfig(read=0.05, seed=2)).train.images)


@pytest.mark.parametrize("layout", MAKE)
def test_given_bounds_go_first(load):
    assert (load(near=0.5, far=900).near, load(near=0.5, far=900).far) == (0.5, 900.0)
    found = load()
    assert (load(near=0.5).near, load(near=0.5).far) == (0.5, found.far)
    with pytest.raises(DataError, match=r"found near 1000, far \d.*, expected near < far"):
        load(near=1000)


@pytest.mark.parametrize("layout", LISTED)
def test_forward(load):
    """The mean camera stands at the origin and looks along -z; near is NDC's."""
    scene = load(geometry="forward", near=2.0)
    c2w = torch.cat([scene.train.c2w, scene.test.c2w])
    torch.testing.assert_close(c2w[:, :, 3].mean(0), torch.zeros(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.nn.functional.normalize(c2w[:, :, 2].mean(0), dim=0), torch.tensor([0.0, 0, 1]))
    assert scene.near == 1.0
    assert scene.far == pytest.approx(load(near=2.0).far / (0.75 * 2.0))
    with pytest.raises(ConfigError, match=r"dataset\.near: found 0\.0, expected more than 0"):
        load(near=0, geometry="forward")


@pytest.mark.parametrize("layout", ["transforms", "colmap"])
def test_missing_pictures_are_left_out_with_one_warning(root, layout):
    names = sorted((root / "images").iterdir())
    for index in (1, 3):
        names[index].unlink()
    config = DATASETS.get(layout)(root=root, geometry="bounded")
    with pytest.warns(UserWarning, match=r"2 of 11 pictures are missing and left out, such as '.*f_01\.png'") as seen:
        scene = config.load()
    assert len(seen) == 1
    assert scene.test.names == ("f_00", "f_10")
    assert len(scene.train) == 7
    for path in names[4:]:
        path.unlink()
    with pytest.raises(DataError, match=r"found 2 pictures; 9 that it lists are missing, such as '.*', expected at le"):
        config.load()


@pytest.mark.parametrize("layout", LISTED)
def test_random_matched_needs_alpha(load):
    with pytest.raises(ConfigError, match=r"dataset\.background: found 'random_matched', expected .*no alpha"):
        load(background="random_matched")


@pytest.mark.parametrize("layout", MAKE)
@pytest.mark.parametrize(
    ("settings", "found"),
    [
        ({"near": 3, "far": 2}, r"dataset\.far: found 2, expected more than dataset\.near, 3"),
        ({"downscale": 50}, r"dataset\.downscale: found 50, expected at most a side of the pictures, \d+x"),
        ({"width": 99}, r"dataset\.width: found 99, expected at most that of the pictures, \d+x"),
        ({"width": 4, "downscale": 2}, r"dataset\.width: found 4, expected null with dataset\.downscale=2"),
        ({"width": "full", "downscale": 2}, r"dataset\.width: found 'full', expected null with dataset\.downscale=2"),
        ({"width": "half"}, r"dataset\.width: found 'half', expected an integer >= 1, full or null"),
    ],
)
def test_settings_that_cannot_be(load, settings, found):
    with pytest.raises(ConfigError, match=found):
        load(**settings)
