"""What the demo advises; that it runs is in test_command_lines.py."""

import pytest

from ctm_plugin.workflows.demo import advice


@pytest.mark.parametrize(
    ("best", "text"),
    [
        ("auto", "Closest to the photographs here: ctm=auto, the default."),
        ("off", "Closest to the photographs here: ctm=off, though ctm=auto is the default."),
    ],
)
def test_advice(best, text):
    assert advice({ctm: {"psnr_enhanced": 20.0 + (ctm == best)} for ctm in ("off", "quick", "auto")}) == text
