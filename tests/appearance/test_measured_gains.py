"""Gains of pictures out of points that several see, and exposures that start from them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from pictures import views

from ctm_plugin.appearance.exposure import Exposure
from ctm_plugin.appearance.measured_gains import MIN_POINTS, gains_by_points, log_gains
from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.scene.views import Points, Scene

VIEWS, POINTS, SIDE = 12, 300, 20


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_gains_are_found_whatever_shines_and_whoever_sees_it(spread):
    """A tenth of the light is a reflection; dark points are seen by others than bright ones."""
    chance = np.random.default_rng(0)
    gains, lights = chance.normal(size=VIEWS) * spread, chance.normal(size=POINTS)
    seen = chance.random((VIEWS, POINTS)) < 0.2 + 0.6 * (lights > np.linspace(-1, 1, VIEWS)[:, None])
    views, points = np.nonzero(seen)
    levels = gains[views] + lights[points] + 0.1 * chance.normal(size=len(views))
    levels += (chance.random(len(views)) < 0.1) * chance.exponential(2, len(views))
    found = log_gains(levels, views, points + 5, VIEWS)
    np.testing.assert_allclose(found - found.mean(), gains - gains.mean(), atol=0.03)


def test_gains_of_pictures_in_a_long_row_are_found():
    """Each sees points of the next one alone."""
    gains = np.random.default_rng(0).normal(size=99)
    views = np.repeat(np.arange(99), 2 * MIN_POINTS)
    points = np.arange(len(views)) - views * MIN_POINTS
    found = log_gains(gains[views] + np.sin(points), views, points, 99)
    np.testing.assert_allclose(found - found.mean(), gains - gains.mean(), atol=1e-6)


def test_pictures_that_see_too_little_are_left_out():
    views = np.repeat([0, 1, 3], [MIN_POINTS, MIN_POINTS, MIN_POINTS - 1])
    points = np.concatenate([np.arange(MIN_POINTS), np.arange(MIN_POINTS), np.arange(MIN_POINTS - 1)])
    assert np.isnan(log_gains(np.zeros(len(views)), views, points, 5)).tolist() == [False, False, True, True, True]
    assert np.isnan(log_gains(*[np.zeros(0, kind) for kind in (float, int, int)], 2)).all()


@pytest.fixture
def windowed():
    """A wall under four gains, whose left half is a window that shines in two pictures; points are on the right."""
    draw, gains = torch.Generator().manual_seed(0), torch.tensor([0.5, 1.0, 2.0, 1.0])
    wall = 0.1 + 0.1 * torch.rand(SIDE, SIDE, 3, generator=draw)
    wall[:, : SIDE // 2] = 0.01
    light = wall * gains[:, None, None, None]
    light[1:3, :, : SIDE // 2] = 1.0
    pictures = replace(
        views(linear_to_srgb(light), mask=torch.ones(4, SIDE, SIDE, dtype=torch.bool)),
        intrinsics=torch.tensor([[SIDE, SIDE, SIDE / 2, SIDE / 2]] * 4).float(),
    )
    places = torch.rand(100, 2, generator=draw) * torch.tensor([0.4, 0.8]) + torch.tensor([0.05, -0.4])
    positions = torch.cat([2 * places, torch.full((100, 1), -2.0)], 1)
    point, view = torch.cartesian_prod(torch.arange(100), torch.arange(4)).unbind(-1)
    return Scene("wall", pictures, pictures, 1.0, 3.0, "bounded", "black", points=Points(positions, point, view)), gains


def test_exposures_start_from_points_where_there_are_some(windowed):
    """Not from the window; the last picture, whose points are masked, by its mean light beside the others'."""
    scene, gains = windowed
    scene.train.mask[3, :, SIDE // 2 :] = False
    found = gains_by_points(scene)
    torch.testing.assert_close(found[:3] - found[1], gains[:3].log(), atol=1e-4, rtol=0)
    assert found[3].isnan()
    started = Exposure(Exposure.Config(), replace(scene.train, gains=found)).log_gain.detach()
    means = Exposure(Exposure.Config(), scene.train).log_gain.detach()
    assert torch.equal(started[:3], found[:3])
    assert torch.equal(Exposure(Exposure.Config(), replace(scene.train, gains=gains.log())).log_gain, gains.log())
    assert started[3] - means[3] == pytest.approx(float((found - means)[:3].median()))


def test_scenes_without_points_have_no_gains(windowed):
    scene, _ = windowed
    none = torch.zeros(0, dtype=torch.long)
    assert gains_by_points(replace(scene, points=None)) is None
    assert gains_by_points(replace(scene, points=Points(scene.points.positions, none, none))) is None
