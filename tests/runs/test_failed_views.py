"""Runs whose lit views are worse than lit photographs say so, and what to try."""

import pytest

from ctm_plugin.runs.evaluate import warn_of_failed_views

LIT = {"psnr_lit": 25.0, "psnr_lit_photo": 24.0, "ssim_lit": 0.8, "ssim_lit_photo": 0.6}
WORSE = {"psnr_lit": 23.0, "ssim_lit": 0.5}


@pytest.mark.parametrize(
    ("scores", "told"),
    [
        ({"detail": 0.01}, "show 0.01 of the real detail of their photographs, expected at least 0.25"),
        ({"detail": 0.9, **LIT, **WORSE}, "farther from the references than the photographs in the same light"),
        ({"detail": 0.0, **LIT, **WORSE}, "expected at least 0.25 and are farther from the references"),
        ({"detail": 0.6}, None),
        ({"detail": None}, None),
        ({}, None),
        ({"detail": 0.5, **LIT}, None),
        ({"detail": 0.5, **LIT, "psnr_lit": 20.0}, None),  # SSIM sees less noise
        ({"detail": None, **LIT, **WORSE, "psnr_lit_photo": None}, None),
    ],
)
@pytest.mark.parametrize("budget", ["quick", None])
def test_when_and_what(recwarn, scores, told, budget):
    warn_of_failed_views(scores, budget)
    messages = [str(each.message) for each in recwarn]
    assert len(messages) == (told is not None)
    if told:
        assert told in messages[0]
        assert ("trainer=standard" in messages[0]) == (budget == "quick")
        assert "ctm cameras" in messages[0]
