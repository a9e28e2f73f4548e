"""The table of colours: which rows and pairs, intervals against scipy, every format."""

import csv
import io

import numpy as np
import pytest
from scipy import stats

from ctm_plugin.cli import main
from ctm_plugin.report.alike import scenes_apart
from ctm_plugin.report.colors import colors_table, has_colors
from ctm_plugin.report.command import choose
from ctm_plugin.report.find import find_runs
from ctm_plugin.report.text import markdown

TRANSFORMS = {
    "rgb": ("ctm=off",),
    "gain": ("ctm=off", "color_space=gain"),
    "log": ("ctm=off", "color_space=log"),
    "auto": ("ctm=auto",),
}
MEANS = {
    "0.05": {"rgb": 30.0, "gain": 31.0, "log": 30.5, "auto": 31.2},
    "0.02": {"rgb": 20.0, "gain": 21.0, "log": 22.0, "auto": 21.8},
}
"""PSNR by exposure and transform: another closed form is best on each scene."""
SEEDS = 3


@pytest.fixture
def swept(made):
    """Runs of two exposures of one scene; their folder, and PSNR by (exposure, transform), an array over seeds."""
    generator = np.random.default_rng(0)
    scores = {}
    for exposure, means in MEANS.items():
        for name, mean in means.items():
            scores[exposure, name] = mean + 0.1 * generator.normal(size=SEEDS)
            for seed, psnr in enumerate(scores[exposure, name]):
                data = ("dataset=blender", "dataset.root=x", f"dataset.exposure={exposure}", "backbone.relative=true")
                folder = made(*data, *TRANSFORMS[name], f"seed={seed}", psnr=float(psnr), psnr_enhanced=psnr / 2,
                              train_seconds=12.0, dataset="lego", protocol=f"lego, exposure {exposure}")  # fmt: skip
    return folder.parent, scores


def table_of(folder):
    return colors_table(scenes_apart(find_runs([folder]).runs))


def found(table, metric="psnr"):
    return {each.label: each for each in table.comparisons if each.metric == metric}


def test_a_row_for_each_transform_and_scene(swept):
    folder, scores = swept
    table = table_of(folder)
    settings = ["off", "off color_space=gain", "off color_space=log light=srgb", "auto"]
    blocks = ("lego (dataset.exposure=0.02)", "lego (dataset.exposure=0.05)", "mean of 2 scenes")
    assert table.labels == [f"{block}: dvgo ctm={setting}" for block in blocks for setting in settings]
    assert [column.metric for column in table.columns] == ["psnr", "psnr_enhanced", "ssim", "lpips", "step_ms"]
    cells = dict(zip(table.labels, table.cells, strict=True))
    first = cells["lego (dataset.exposure=0.02): dvgo ctm=auto"]
    assert first[0].mean == pytest.approx(scores["0.02", "auto"].mean())
    assert first[0].std == pytest.approx(scores["0.02", "auto"].std(ddof=1))
    assert first[-1].mean == pytest.approx(12.0)  # of 1000 steps
    pooled = cells["mean of 2 scenes: dvgo ctm=off"][0]
    assert pooled.mean == pytest.approx((scores["0.02", "rgb"].mean() + scores["0.05", "rgb"].mean()) / 2)
    assert [cells[f"{blocks[0]}: dvgo ctm={setting}"][0].rank for setting in settings] == [0, 0, 1, 2]


@pytest.mark.parametrize(("reference", "best"), [("RGB", ("rgb", "rgb")), ("best closed form", ("log", "gain"))])
def test_differences_are_those_of_scipy(swept, reference, best):
    """On each scene, and on both together, each against its own best closed form."""
    folder, scores = swept
    comparisons = found(table_of(folder))
    pairs = [
        (scores[exposure, "auto"], scores[exposure, name]) for exposure, name in zip(MEANS, best[::-1], strict=True)
    ]
    blocks = {f"lego (dataset.exposure={exposure})": pair for exposure, pair in zip(MEANS, pairs, strict=True)}
    blocks["mean of 2 scenes"] = tuple(map(np.concatenate, zip(*pairs, strict=True)))
    for block, (ours, theirs) in blocks.items():
        start = f"{block}: dvgo ctm=auto - {reference}"
        (each,) = (value for label, value in comparisons.items() if label.startswith(start))
        low, high = stats.ttest_rel(ours, theirs).confidence_interval(0.95)
        assert (each.mean - each.half, each.mean + each.half) == (pytest.approx(low), pytest.approx(high))
        assert each.pairs == len(ours)
        assert each.better is (None if low < 0 < high else bool(low > 0))


def test_the_best_closed_form_is_named_and_not_compared_with_itself(swept):
    comparisons = found(table_of(swept[0]))
    against_best = [label for label in comparisons if "best closed form" in label]
    assert against_best == [
        "lego (dataset.exposure=0.02): dvgo ctm=auto - best closed form (log)",
        "lego (dataset.exposure=0.05): dvgo ctm=auto - best closed form (gain)",
        "mean of 2 scenes: dvgo ctm=off - best closed form (gain, log)",
        "mean of 2 scenes: dvgo ctm=off color_space=gain - best closed form (gain, log)",
        "mean of 2 scenes: dvgo ctm=off color_space=log light=srgb - best closed form (gain, log)",
        "mean of 2 scenes: dvgo ctm=auto - best closed form (gain, log)",
    ]
    assert not any("ctm=off - RGB" in label for label in comparisons)


def test_what_a_scene_has_in_all_rows_is_no_row_of_its_own(made):
    """Rows are pooled over scenes that want other settings; it is told which."""
    for scene, more in (("lego", "backbone.coarse=false"), ("room", "backbone.coarse=auto")):
        for ctm in ("off", "auto"):
            for space in ("rgb", "gain") if ctm == "off" else ("rgb",):
                folder = made(f"ctm={ctm}", f"color_space={space}", "backbone.relative=true", more,
                              psnr=31.0 if ctm == "auto" else 30.0, dataset=scene, protocol=scene)  # fmt: skip
    table = table_of(folder.parent)
    assert found(table)["mean of 2 scenes: dvgo ctm=auto - RGB"].pairs == 2
    assert table.notes[-2:] == [
        "All of dvgo on lego: backbone.coarse=False.", "All of dvgo on room: backbone.coarse=auto.",
    ]  # fmt: skip
    made("ctm=off", "backbone.relative=true", "backbone.coarse=true", dataset="room", protocol="room")
    rows = [label for label in table_of(folder.parent).labels if label.startswith("room: dvgo ctm=off (")]
    assert rows == [f"room: dvgo ctm=off (backbone.coarse={value})" for value in ("True", "auto")]


def test_other_random_backgrounds_are_no_other_scene(made):
    """They are of the training alone: rows are paired across them, those of one transform are told apart."""
    data = ("dataset=blender", "dataset.root=x", "dataset.background=random", "backbone.relative=true")
    for exposure in ("0.05", "0.02"):
        of = {"dataset": "lego", "protocol": f"lego, exposure {exposure}"}
        dark = (*data, f"dataset.exposure={exposure}")
        made(*dark, "ctm=off", "dataset.background_level=scene", psnr=30.0, **of)
        made(*dark, "ctm=off", "color_space=gain", "dataset.background_level=scene", psnr=30.5, **of)
        folder = made(*dark, "ctm=auto", psnr=31.0, **of)
    table = table_of(folder.parent)
    assert found(table)["mean of 2 scenes: dvgo ctm=auto - RGB"].pairs == 2
    blocks = [f"lego (dataset.exposure={exposure})" for exposure in ("0.02", "0.05")]
    told = [note for note in table.notes if "background_level" in note]
    assert told == [f"{block}: dataset.background_level is None for ctm=auto, scene for ctm=off." for block in blocks]
    made(*dark, "ctm=off", "dataset.background_level=0.04", psnr=32.0, **of)
    table = table_of(folder.parent)
    rows = [label for label in table.labels if label.startswith(f"{blocks[0]}: dvgo ctm=off (")]
    assert rows == [f"{blocks[0]}: dvgo ctm=off (dataset.background_level={level})" for level in ("0.04", "scene")]
    differences = {label.partition(" - ")[2]: each.mean for label, each in found(table).items()
                   if label.startswith(f"{blocks[0]}: dvgo ctm=auto")}  # fmt: skip
    assert differences == {
        "RGB (dataset.background_level=0.04)": -1.0, "RGB (dataset.background_level=scene)": 1.0,
        "best closed form (gain)": 0.5,
    }  # fmt: skip
    assert "mean of 2 scenes: dvgo ctm=off color_space=gain" in table.labels
    assert any(note.startswith("Not on all 2 scenes, so not in their mean: dvgo ctm=off, ") for note in table.notes)


def test_an_appearance_is_compared_with_its_own(made):
    for appearance, psnr in (("none", 30.0), ("affine", 35.0)):
        made("ctm=off", f"appearance={appearance}", "backbone.relative=true", psnr=psnr)
    made("ctm=off", "color_space=gain", "backbone.relative=true", psnr=30.5)
    folder = made("ctm=auto", "backbone.relative=true", psnr=31.0)
    assert found(table_of(folder.parent))["still_life: dvgo ctm=auto - RGB"].mean == 1.0


def test_a_missing_pair_is_left_out_and_told(made):
    for seed, psnr in enumerate((31.0, 32.0, 40.0)):
        made("ctm=auto", "backbone.relative=true", f"seed={seed}", psnr=psnr)
    for seed, psnr in enumerate((30.0, 30.0)):
        made("ctm=off", "backbone.relative=true", f"seed={seed}", psnr=psnr)
    # The better of the two closed forms has one seed alone, and is not taken for the best.
    for space, values in (("gain", (30.5, 30.5)), ("log", (39.0,))):
        for seed, psnr in enumerate(values):
            folder = made("ctm=off", f"color_space={space}", "backbone.relative=true", f"seed={seed}", psnr=psnr)
    table = table_of(folder.parent)
    comparisons = found(table)
    plain, best = (comparisons[f"still_life: dvgo ctm=auto - {name}"] for name in ("RGB", "best closed form (gain)"))
    assert (plain.mean, plain.pairs, best.mean, best.pairs) == (1.5, 2, 1.0, 2)
    assert table.notes[-1] == ("Without a pair in RGB, left out of differences: dvgo ctm=auto on still_life, seed 2.")


def test_without_rgb_or_closed_forms_there_is_nothing_to_compare_with(made):
    folder = made("ctm=off", "color_space=gain")
    table = table_of(folder)
    assert table.comparisons == []
    assert table.labels == ["still_life: dvgo ctm=off color_space=gain"]


def test_the_table_of_runs_that_are_of_it(swept, made):
    runs = find_runs([swept[0]]).runs
    assert [table.title for table in choose(scenes_apart(runs), None, None)] == ["Colours"]
    papers = [made("ctm=off", "color_space=lab"), made("ctm=quick")]
    assert not has_colors(find_runs(papers).runs)


def test_formats(swept, tmp_path, capsys):
    folder, _ = swept
    for name, ending in (("csv", "csv"), ("latex", "tex"), ("html", "html")):
        assert main(["report", str(folder), f"format={name}", f"out={tmp_path / 'table'}.{ending}"]) == 0
    lines = list(csv.DictReader(io.StringIO((tmp_path / "table.csv").read_text())))
    mine = [line for line in lines if line["row"] == "mean of 2 scenes: dvgo ctm=auto" and line["metric"] == "psnr"]
    assert [(line["against"], line["pairs"]) for line in mine] == [("RGB", "6"), ("best closed form (gain, log)", "6")]
    assert r"lego (dataset.exposure=0.02): dvgo ctm=off color\_space=gain" in (tmp_path / "table.tex").read_text()
    assert "dvgo ctm=auto - best closed form (log)" in (tmp_path / "table.html").read_text()
    capsys.readouterr()
    assert main(["report", str(folder)]) == 0
    assert capsys.readouterr().out == markdown(table_of(folder))
