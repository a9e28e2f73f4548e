"""The table of lit views: every cell where it belongs, nothing beside what it cannot be compared with."""

import pytest
from strangers import put

from ctm_plugin.cli import main
from ctm_plugin.report.labels import find_runs
from ctm_plugin.report.tables import all_runs, choose, lit_views
from ctm_plugin.report.text import markdown


@pytest.fixture
def lit(made):
    """``lit(scene, *arguments, **metrics)``: a run that was scored against references."""

    def make(scene: str, *arguments: str, **metrics):
        scores = {"dataset": scene, "protocol": scene, "lpips_net": "alex", "psnr": 38.0, "lpips_lit": 0.2}
        scores |= {"psnr_lit": 22.0, "ssim_lit": 0.8, "psnr_lit_fitted": 26.0, "psnr_lit_photo": 25.1} | metrics
        folder = made(*arguments, **scores)
        for key, value in {"name": "transforms", "root": scene}.items():
            put(folder / "config.yaml", f"dataset.{key}", value)
        return folder

    return make


def rows(table):
    return {label: [cell.mean for cell in cells] for label, cells in table.rows}


def test_a_scene(lit):
    lit("buu", "ctm=off", psnr_lit=21.0)
    folder = lit("buu", "ctm=quick", psnr_lit=23.0)
    table = lit_views(find_runs([folder.parent]).runs)
    assert [column.label for column in table.columns] == [
        "PSNR, lit", "SSIM, lit", "LPIPS, lit", "PSNR",
    ]  # fmt: skip
    found = rows(table)
    assert found["buu: ctm=off"] == [21.0, 0.8, 0.2, 38.0]
    assert found["buu: ctm=quick"] == [23.0, 0.8, 0.2, 38.0]
    assert found["buu: the dark photographs themselves, lit"] == [25.1, None, None, None]
    oracle = "buu: ctm=quick, colours fitted to the references (an oracle)"
    assert found[oracle] == [26.0, None, None, None]
    ranked = {label: cells[0].rank for label, cells in table.rows if cells[0].rank}
    assert ranked == {"buu: ctm=quick": 1, "buu: ctm=off": 2}
    text = markdown(table)
    assert "| buu: ctm=quick | **23.00** | 0.8000 | 0.2000 | 38.00 |" in text
    assert "| buu: the dark photographs themselves, lit | 25.10 | - | - | - |" in text
    assert "paper" not in text.lower()


def test_the_mean_is_of_settings_that_have_all_scenes(lit):
    lit("buu", "ctm=off", psnr_lit=20.0)
    lit("buu", "ctm=quick", psnr_lit=22.0)
    folder = lit("bike", "ctm=quick", psnr_lit=23.0, psnr_lit_photo=20.0)
    found = rows(lit_views(find_runs([folder.parent]).runs))
    assert found["mean of 2 scenes: ctm=quick"][0] == 22.5
    assert found["mean of 2 scenes: the dark photographs themselves, lit"][0] == pytest.approx(22.55)
    assert not any(label.startswith("mean of 2 scenes: ctm=off") for label in found)


def test_photographs_that_are_missing(lit):
    folder = lit("cave", psnr=None, psnr_lit_photo=None, converged=None)
    found = rows(lit_views(find_runs([folder]).runs))
    assert found["cave: the dark photographs themselves, lit"] == [None, None, None, None]
    assert found["cave: backbone=dvgo ctm=quick"] == [22.0, 0.8, 0.2, None]


def test_lit_runs_have_one_table_and_others_theirs(lit, made, capsys):
    lit("buu", "ctm=off")
    folder = lit("buu", "ctm=quick")
    assert [table.title for table in choose(find_runs([folder.parent]), None, None)] == ["All runs: buu", "Lit views"]
    made("ctm=off")
    made("ctm=quick")
    assert main(["report", str(folder.parent)]) == 0
    told = capsys.readouterr().out
    assert "### Lit views" in told
    assert "| still_life: ctm=off |" in told
    assert "Table" not in told


def test_appearances_have_rows_of_their_own_and_a_column(lit, capsys):
    """Scenes stand apart by how their pictures were exposed; without an appearance anywhere nothing is new."""
    lit("room", "appearance=none", psnr_fitted=40.0, data="a")
    for appearance, fitted in (("none", 35.0), ("exposure", 39.0)):
        folder = lit("room", f"appearance={appearance}", psnr_fitted=fitted, data="b")
        put(folder / "config.yaml", "dataset.exposure", 0.5)
    assert main(["report", str(folder.parent)]) == 0
    text = capsys.readouterr().out
    assert "light fitted to the left" in text
    assert "room (dataset.exposure=1): backbone=dvgo ctm=" in text
    assert "room (dataset.exposure=0.5): appearance=exposure" in text
    assert "39.00" in text


def test_the_column_of_fitted_views_is_the_models_alone(lit):
    """Neither the photographs' nor an oracle's."""
    folder = lit("buu", "ctm=off", "appearance=none", psnr_fitted=40.0)
    lit("buu", "ctm=off", "appearance=exposure", psnr_fitted=47.5)
    table = lit_views(find_runs([folder.parent]).runs)
    assert {len(cells) for _, cells in table.rows} == {len(table.columns)}
    last = {label: cells[-1].mean for label, cells in table.rows}
    assert [label for label, mean in last.items() if mean is not None] == [
        "buu: backbone=dvgo ctm=off", "buu: appearance=exposure",
    ]  # fmt: skip


def test_what_scenes_have_in_all_rows_leaves_the_mean(lit):
    """A key that one scene's runs share would take the others' rows apart from theirs."""
    for scene, more in (("buu", ()), ("bike", ("backbone.coarse=false",))):
        lit(scene, "ctm=off", *more, psnr_lit=20.0)
        folder = lit(scene, "ctm=auto", *more, psnr_lit=22.0)
    found = find_runs([folder.parent])
    assert rows(lit_views(found.runs))["mean of 2 scenes: ctm=auto"][0] == 22.0
    table = all_runs(found)
    column = [column.metric for column in table.columns].index("psnr_lit")
    assert [each.pairs for _, cells in table.rows for each in cells[column].differences] == [1, 1, 2]
    assert "All of dvgo on bike: backbone.coarse=false." in table.notes
