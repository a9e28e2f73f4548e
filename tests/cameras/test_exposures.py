"""Gains of pictures out of points that several see."""

import numpy as np
import pytest

from ctm_plugin.cameras.exposures import MIN_POINTS, log_gains, medians

VIEWS, POINTS = 12, 300


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_gains_are_found_whatever_shines_and_whoever_sees_it(spread):
    """A tenth of the light is a reflection; dark points are seen by others than bright ones."""
    chance = np.random.default_rng(0)
    gains, lights = chance.normal(size=VIEWS) * spread, chance.normal(size=POINTS)
    views, points = np.nonzero(
        chance.random((VIEWS, POINTS)) < 0.2 + 0.6 * (lights > np.linspace(-1, 1, VIEWS)[:, None])
    )
    levels = gains[views] + lights[points] + 0.1 * chance.normal(size=len(views))
    levels += (chance.random(len(views)) < 0.1) * chance.exponential(2, len(views))
    np.testing.assert_allclose(log_gains(levels, views + 5, points), gains - gains.mean(), atol=0.03)


def test_pictures_that_see_too_little_are_left_out():
    views = np.repeat([1, 2, 3], [MIN_POINTS, MIN_POINTS, MIN_POINTS - 1])
    points = np.concatenate([np.arange(MIN_POINTS), np.arange(MIN_POINTS), np.arange(MIN_POINTS - 1)])
    assert len(log_gains(np.zeros(len(views)), views, points)) == 2
    assert len(log_gains(*[np.zeros(0, kind) for kind in (float, int, int)])) == 0


def test_medians():
    values, groups = np.array([5.0, 1.0, 2.0, 9.0, 4.0]), np.array([1, 0, 0, 1, 1])
    assert medians(values, groups).tolist() == [1.5, 5.0]
