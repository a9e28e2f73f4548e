"""``docs/evidence/figures.py``: the paper's figures out of run folders, and what is said where pictures are missing."""

import imageio.v3 as iio
import pytest
from pages import load

from ctm_plugin.errors import CTMError

subject = load("docs/evidence/figures.py")


def test_names_are_shown_as_they_are(made, tmp_path):
    """Between dollars matplotlib would read formulas."""
    for arguments in (["ctm=off"], ["ctm=on"]):
        folder = made(*arguments, views=True, dataset=r"$\bad{ a_b$")
    subject.main(["4", str(folder.parent), f"out={tmp_path / 'figure'}"])


@pytest.mark.parametrize("name", ["3", "4", "5", "7", "8"])
def test_a_figure(table4, made, tmp_path, name):
    made("ctm=off", "color_space=lab", views=True)
    made("ctm.k=1", views=True)
    out = tmp_path / "figures" / "one"
    subject.main([name, str(table4), f"out={out}"])
    assert iio.imread(f"{out}.png").std() > 1
    assert out.with_suffix(".pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize("name", ["3", "4", "5", "6", "7", "8", "C"])
def test_what_is_missing_is_said(made, name):
    with pytest.raises(CTMError, match=f"figure={name}: found nothing to show, expected"):
        subject.main([name, str(made("ctm=off"))])


def test_a_figure_that_is_none(made):
    with pytest.raises(CTMError, match="figure: found 9, expected one of 3, 4"):
        subject.main(["9", str(made("ctm=off"))])


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("3", "found nothing to show, expected a run without the term img and one with all"),
        ("4", "found no picture of the "),
        ("7", "found nothing to show, expected a run without the term rand and one with all"),
    ],
)
def test_pictures_that_are_missing_are_told(table4, name, told):
    """Those of all runs but the first, which is without CTM."""
    subject.main([name, str(table4), f"out={table4 / 'x'}"])
    for path in table4.glob("*/*/r_1.png"):
        if path.parts[-3] != "001":
            path.unlink()
    with pytest.raises(CTMError, match=told):
        subject.main([name, str(table4), f"out={table4 / 'y'}"])
