"""What cameras see of Gaussians, against the pictures themselves and closed forms."""

import math

import pytest
import torch
from gaussian_scenes import NEAR, setting, views_of

from ctm_plugin.splats.gaussians import Gaussians, camera_of
from ctm_plugin.splats.render import picture
from ctm_plugin.splats.seen import as_wide_as_pixels, pixels_made, times_seen


def test_pixels_made_are_what_a_gaussian_s_own_colour_adds():
    """White before black, one by one; all together make what the light does not pass."""
    of = setting(12, channels=1, degrees=1, width=20, height=16)
    camera, black = of.camera, of.gaussians._replace(sh0=torch.full((12, 1), -1e3), shN=torch.zeros(12, 0))
    shift, found = torch.zeros(12, 2), pixels_made(of.gaussians, [camera, camera])
    for index in range(12):
        one = black.sh0.clone()
        one[index] = 0.5 / 0.28209479177387814  # white
        shown = picture(black._replace(sh0=one), camera, shift, 1, 0.0, 0)[0].sum()
        assert found[index] == pytest.approx(float(shown), rel=1e-3, abs=1e-3)
    left = picture(black, camera, shift, 1, 0.0, 0)[1]
    assert found.sum() == pytest.approx(float((1 - left).sum()), rel=1e-3)
    away = of.gaussians._replace(means=of.gaussians.means + torch.tensor([0.0, 0.0, 1e3]))
    assert (pixels_made(away, [camera]) == 0).all()


def cameras(*eyes: tuple[float, float, float]) -> list:
    """Cameras that look along -z, 90 degrees wide: a pixel is 1 / 10 of what is 1 away."""
    c2w = torch.eye(3, 4).repeat(len(eyes), 1, 1)
    c2w[:, :, 3] = torch.tensor(eyes)
    views = views_of(c2w, (10.0, 10.0, 10.0, 10.0), 20, 20)
    return [camera_of(views, index, NEAR) for index in range(len(eyes))]


def test_times_seen():
    places = torch.tensor([[-0.5, 0, -1], [0.9, -0.9, -1], [1.5, 0, -1], [0, 0, 1], [0, 0, -0.5 * NEAR]])
    assert times_seen(places, cameras((0, 0, 0), (1, 0, 0))).tolist() == [1, 2, 1, 0, 0]


def test_as_wide_as_the_nearest_camera_s_pixels():
    sizes = torch.tensor([[1e-6, 0.5, 2.0]])
    means, turns = torch.tensor([[0.0, 0, -3]]), torch.tensor([[1.0, 0, 0, 0]])
    given = Gaussians(means, sizes.log(), turns, torch.zeros(1, 1), torch.zeros(1, 3), torch.zeros(1, 0))
    wide = as_wide_as_pixels(given, cameras((0, 0, 0), (0, 0, 7)))
    expected = [math.sqrt(size**2 + 0.3 * 0.3**2) for size in sizes[0].tolist()]
    assert wide.scales.exp()[0].tolist() == pytest.approx(expected, rel=1e-5)
    assert wide.means is given.means
