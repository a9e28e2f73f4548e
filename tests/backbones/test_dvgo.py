"""DVGO's two stages."""

import pytest

from ctm_plugin.assemble import assemble


@pytest.mark.parametrize(
    ("decay", "coarse", "fine", "of_coarse", "of_fine"),
    [
        ("null", 100, 300, 300, 300),
        ("null", 900, 300, 900, 300),
        ("50", 900, 300, 50, 50),
    ],
)
def test_rates_fall_to_a_tenth(compose, decay, coarse, fine, of_coarse, of_fine):
    settings = (f"lr_decay_steps={decay}", f"coarse_steps={coarse}", f"steps={fine}", "coarse=true")
    dvgo = assemble(compose("backbone=dvgo", *(f"backbone.{each}" for each in settings))).backbone
    for stage, start, length in (("coarse", 0, of_coarse), ("fine", coarse, of_fine)):
        dvgo.stage = stage
        schedule = dvgo.field_schedule()
        assert schedule(start) == 1
        assert schedule(start + length) == pytest.approx(0.1)
        assert schedule(start + length // 2) == pytest.approx(0.1**0.5)
