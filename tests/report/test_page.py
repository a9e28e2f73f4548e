"""What the HTML page shows of a run's curves."""

import pytest
from torch.utils.tensorboard import SummaryWriter

from ctm_plugin.report.page import curve_of


@pytest.mark.parametrize(
    ("points", "shown"),
    [
        ({"psnr/test_view": [20.0, 30.0], "psnr/rgb": [1.0, 2.0, 3.0]}, ([0, 1], [20.0, 30.0])),
        ({"psnr/test_view": [20.0], "psnr/rgb": [1.0, 2.0, 3.0]}, ([0, 1, 2], [1.0, 2.0, 3.0])),  # a point is no curve
        ({"psnr/test_view": [20.0], "loss/total": [1.0, 2.0]}, None),
    ],
)
def test_curve(tmp_path, points, shown):
    with SummaryWriter(tmp_path / "tensorboard") as writer:
        for tag, values in points.items():
            for step, value in enumerate(values):
                writer.add_scalar(tag, value, step)
    assert curve_of(tmp_path) == shown


def test_no_curves(tmp_path):
    assert curve_of(tmp_path) is None
