import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.metrics.depth import mean_absolute_error, surface_errors


@given(st.integers(0, 2**31), st.floats(0.0, 0.9))
def test_errors_agree_with_numpy_on_the_pixels_that_count(seed, holes):
    rng = np.random.default_rng(seed)
    true = rng.uniform(1, 5, (2, 6, 7)).astype(np.float32)
    true[rng.random(true.shape) < holes] = np.nan
    depth = rng.uniform(1, 5, true.shape).astype(np.float32)
    true.flat[0] = 2.0
    errors = surface_errors(torch.from_numpy(depth), torch.from_numpy(true))
    expected = np.abs(depth.astype(np.float64) - true)[~np.isnan(true)]
    assert mean_absolute_error(errors) == pytest.approx(expected.mean(), rel=1e-12)


def test_without_a_surface_there_is_no_error():
    errors = surface_errors(torch.ones(3, 4), torch.full((3, 4), torch.nan))
    assert len(errors) == 0
    assert mean_absolute_error(errors) is None


def test_a_predicted_nan_is_not_hidden():
    errors = surface_errors(torch.tensor([torch.nan, 1.0]), torch.tensor([1.0, 1.0]))
    assert np.isnan(mean_absolute_error(errors))
