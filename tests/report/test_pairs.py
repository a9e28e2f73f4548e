"""Pictures of runs in another light than they were written in."""

from dataclasses import replace

import numpy as np
import pytest

from ctm_plugin.cli import main
from ctm_plugin.color.light import brighten
from ctm_plugin.report.find import find_runs
from ctm_plugin.report.pairs import picture, pictures, view_name, where_they_differ
from ctm_plugin.runs.load import load_posed

SIZES = ("trainer=smoke", "backbone.steps_alone=3", "backbone.coarse=false", "backbone.grow=[]")


@pytest.fixture(scope="module")
def runs(ball, tmp_path_factory):
    folder = tmp_path_factory.mktemp("lifted")
    data = ("dataset=blender", f"dataset.root={ball}", "dataset.exposure=0.02")
    for ctm, more in (("off", ()), ("quick", ("ctm.pretrain_steps=2",))):
        assert main([*data, *SIZES, f"ctm={ctm}", *more, f"hydra.run.dir={folder / ctm}"]) == 0
    return folder


def test_lifted_pictures_are_rendered_again(runs):
    run = find_runs([runs / "off"]).runs[0]
    posed = load_posed(run.folder)
    test = posed.module.scene.test
    rgb = posed.module.render_view(test, test.names.index(view_name(run)))["rgb"].float().cpu()
    for light, factor in (("1.5", 2**1.5), ("auto", posed.factor)):
        expected = (255 * brighten(rgb, factor)).round()
        np.testing.assert_allclose(picture(replace(run, light=light), "lifted"), expected.detach(), atol=1)
    assert np.array_equal(picture(replace(run, light="2"), "render"), picture(run, "render"))
    assert set(pictures(run)) - set(pictures(replace(run, light="off"))) == {"lifted"}


def test_the_report_takes_light(runs, tmp_path, capsys):
    for light in ("2", "off"):
        assert main(["report", str(runs), "format=html", f"light={light}", f"out={tmp_path / light}.html"]) == 0
    texts = [(tmp_path / f"{light}.html").read_text() for light in ("2", "off")]
    assert ["<figcaption>lifted</figcaption>" in text for text in texts] == [True, False]
    capsys.readouterr()
    assert main(["report", str(runs), "light=12"]) == 1
    assert "light: found '12', expected auto, off, or a number of stops" in capsys.readouterr().err


def test_a_tint_of_all_is_no_difference():
    """The window is where something differs, not where black became nearly black."""
    first = np.zeros((32, 40, 3), np.uint8)
    second = first + np.uint8(9)
    second[20:24, 8:12] = 60
    rows, columns = where_they_differ(first, second)
    assert rows.start <= 20 < 24 <= rows.stop
    assert columns.start <= 8 < 12 <= columns.stop
