"""The first table: which rows, columns and pairs, intervals against scipy, every format."""

import numpy as np
import pytest
from scipy import stats

from ctm_plugin.report.labels import find_runs
from ctm_plugin.report.tables import all_runs
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
    return all_runs(find_runs([folder]))


def found(table, metric="psnr"):
    """Paired differences by both rows' labels."""
    return {
        f"{label} - {each.against}": each
        for label, cells in table.rows
        for cell, column in zip(cells, table.columns, strict=True)
        if column.metric == metric
        for each in cell.differences
    }


def differences(table, metric="psnr"):
    return {label: each.mean for label, each in found(table, metric).items()}


def labels(table):
    return [label for label, _ in table.rows]


@pytest.mark.slow
def test_a_row_for_each_transform_and_scene(swept):
    folder, scores = swept
    table = table_of(folder)
    settings = ["off", "off color_space=gain", "off color_space=log", "auto"]
    blocks = ("lego (dataset.exposure=0.02)", "lego (dataset.exposure=0.05)", "mean of 2 scenes")
    assert labels(table) == [f"{block}: ctm={setting}" for block in blocks for setting in settings]
    assert [column.metric for column in table.columns] == ["psnr", "psnr_enhanced", "ssim", "lpips", "train_seconds"]
    cells = dict(table.rows)
    first = cells["lego (dataset.exposure=0.02): ctm=auto"]
    assert first[0].mean == pytest.approx(scores["0.02", "auto"].mean())
    assert first[0].std == pytest.approx(scores["0.02", "auto"].std(ddof=1))
    assert first[-1].mean == pytest.approx(12.0)
    pooled = cells["mean of 2 scenes: ctm=off"][0]
    assert pooled.mean == pytest.approx((scores["0.02", "rgb"].mean() + scores["0.05", "rgb"].mean()) / 2)
    assert [cells[f"{blocks[0]}: ctm={setting}"][0].rank for setting in settings] == [0, 0, 1, 2]


@pytest.mark.parametrize(("reference", "best"), [("ctm=off", ("rgb", "rgb")), ("best closed form", ("log", "gain"))])
def test_differences_are_those_of_scipy(swept, reference, best):
    """On each scene, and on both together, each against its own best closed form."""
    folder, scores = swept
    comparisons = found(table_of(folder))
    pairs = [(scores[light, "auto"], scores[light, name]) for light, name in zip(MEANS, best[::-1], strict=True)]
    blocks = {f"lego (dataset.exposure={exposure})": pair for exposure, pair in zip(MEANS, pairs, strict=True)}
    blocks["mean of 2 scenes"] = tuple(map(np.concatenate, zip(*pairs, strict=True)))
    for block, (ours, theirs) in blocks.items():
        start = f"{block}: ctm=auto - {reference}"
        (each,) = (value for label, value in comparisons.items() if label.startswith(start))
        low, high = stats.ttest_rel(ours, theirs).confidence_interval(0.95)
        assert (each.mean - each.half, each.mean + each.half) == (pytest.approx(low), pytest.approx(high))
        assert each.pairs == len(ours)
        assert each.better is (None if low < 0 < high else bool(low > 0))


def test_the_best_closed_form_is_named_and_not_compared_with_itself(swept):
    comparisons = found(table_of(swept[0]))
    against_best = [label for label in comparisons if "best closed form" in label]
    assert against_best == [
        "lego (dataset.exposure=0.02): ctm=auto - best closed form (log)",
        "lego (dataset.exposure=0.05): ctm=auto - best closed form (gain)",
        "mean of 2 scenes: ctm=off - best closed form (gain, log)",
        "mean of 2 scenes: ctm=off color_space=gain - best closed form (gain, log)",
        "mean of 2 scenes: ctm=off color_space=log - best closed form (gain, log)",
        "mean of 2 scenes: ctm=auto - best closed form (gain, log)",
    ]
    assert not any("ctm=off - ctm=off" in label for label in comparisons)


def test_what_a_scene_has_in_all_rows_is_no_row_of_its_own(made):
    """Rows are pooled over scenes that want other settings; it is told which."""
    for scene, more in (("lego", "backbone.coarse=false"), ("room", "backbone.coarse=auto")):
        for ctm in ("off", "auto"):
            for space in ("rgb", "gain") if ctm == "off" else ("rgb",):
                folder = made(f"ctm={ctm}", f"color_space={space}", "backbone.relative=true", more,
                              psnr=31.0 if ctm == "auto" else 30.0, dataset=scene, protocol=scene)  # fmt: skip
    table = table_of(folder.parent)
    assert found(table)["mean of 2 scenes: ctm=auto - ctm=off"].pairs == 2
    told = [note for note in table.notes if note.startswith("All of")]
    assert told == ["All of dvgo on lego: backbone.coarse=false.", "All of dvgo on room: backbone.coarse=auto."]
    made("ctm=off", "backbone.relative=true", "backbone.coarse=true", dataset="room", protocol="room")
    rows = [label for label in labels(table_of(folder.parent)) if label.startswith("room: ctm=off backbone")]
    assert rows == [f"room: ctm=off backbone.coarse={value}" for value in ("auto", "true")]


@pytest.mark.slow
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
    assert found(table)["mean of 2 scenes: ctm=auto - ctm=off"].pairs == 2
    blocks = [f"lego (dataset.exposure={exposure})" for exposure in ("0.02", "0.05")]
    told = [note for note in table.notes if "background_level" in note]
    assert told == [f"{block}: dataset.background_level is null for ctm=auto, scene for ctm=off." for block in blocks]
    made(*dark, "ctm=off", "dataset.background_level=0.04", psnr=32.0, **of)
    table = table_of(folder.parent)
    rows = [label for label in labels(table) if label.startswith(f"{blocks[0]}: ctm=off dataset")]
    assert rows == [f"{blocks[0]}: ctm=off dataset.background_level={level}" for level in ("0.04", "scene")]
    differences = {label.partition(" - ")[2]: each.mean for label, each in found(table).items()
                   if label.startswith(f"{blocks[0]}: ctm=auto")}  # fmt: skip
    assert differences == {
        "ctm=off dataset.background_level=0.04": -1.0, "ctm=off dataset.background_level=scene": 1.0,
        "best closed form (gain)": 0.5,
    }  # fmt: skip
    assert "mean of 2 scenes: ctm=off color_space=gain" in labels(table)


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
    plain, best = (comparisons[f"ctm=auto - {name}"] for name in ("ctm=off", "best closed form (gain)"))
    assert (plain.mean, plain.pairs, best.mean, best.pairs) == (1.5, 2, 1.0, 2)
    assert "| +1.50 ± 6.35 (2) |" in markdown(table)  # of three seeds


def test_a_difference_for_each_key_that_differs(made):
    for P, enc, psnr in ((0, "1.5", 30.0), (4, "1.5", 31.0), (0, "5", 32.0), (4, "5", 34.0)):
        folder = made("ctm=quick", f"ctm.P={P}", f"ctm.weights.enc={enc}", psnr=psnr)
    table = table_of(folder.parent)
    names = [f"ctm.P={P} ctm.weights.enc={enc}" for P in (0, 4) for enc in ("1.5", "5")]
    assert labels(table) == names
    assert differences(table) == {
        f"{names[1]} - {names[0]}": 2.0, f"{names[2]} - {names[0]}": 1.0,
        f"{names[3]} - {names[1]}": 2.0, f"{names[3]} - {names[2]}": 3.0,
    }  # fmt: skip


def test_of_a_star_the_middle_is_the_reference(made):
    """Each arm beside the value that most rows have; the transform beside RGB besides."""
    for P, k, psnr in ((0, 3, 31.0), (4, 3, 33.0), (10, 3, 30.0), (4, 1, 32.0)):
        folder = made("ctm=quick", f"ctm.P={P}", f"ctm.k={k}", psnr=psnr)
    table = table_of(folder.parent)
    assert labels(table) == ["ctm.P=0", "ctm.P=4 ctm.k=1", "ctm.P=4", "ctm.P=10"]
    assert "In all rows without other values: ctm.k=3." in table.notes
    assert sorted(differences(table).values()) == [-3.0, -2.0, -1.0]


def test_each_preset_is_compared_with_none_of_its_backbone(made):
    for backbone, ctm, psnr in (("dvgo", "off", 30), ("dvgo", "auto", 31), ("nerf", "off", 20), ("nerf", "auto", 23)):
        folder = made(f"backbone={backbone}", f"ctm={ctm}", psnr=psnr)
    assert differences(table_of(folder.parent)) == {
        "backbone=dvgo ctm=auto - backbone=dvgo ctm=off": 1.0, "backbone=nerf ctm=auto - backbone=nerf ctm=off": 3.0,
        "backbone=nerf ctm=off - backbone=dvgo ctm=off": -10.0,
        "backbone=nerf ctm=auto - backbone=dvgo ctm=auto": -8.0,
    }  # fmt: skip


def test_one_seed_is_said_once(made):
    folder = made("ctm=off")
    made("ctm=auto", psnr=31.0)
    told = markdown(table_of(folder.parent))
    assert told.count("no interval") == 1
    assert "| ctm=auto - ctm=off | +1.00 |" in told
    for ctm, psnr in (("off", 30.0), ("auto", 31.1)):
        made(f"ctm={ctm}", "seed=1", psnr=psnr)
    told = markdown(table_of(folder.parent))
    assert "no interval" not in told
    assert "| ctm=auto - ctm=off | +1.05 ± 0.64 (2) better |" in told


def test_what_did_not_converge_is_explained_below(made):
    folder = made("ctm=off", converged=False, train_seconds=12.0)
    told = markdown(table_of(folder))
    assert "| N.C. | N.C. | N.C. | 12 |" in told
    assert told.count("N.C. (not converged)") == 1
    assert "No run converged" in told
    made("ctm=auto")
    told = markdown(table_of(folder.parent))
    assert "No run converged" not in told
    assert "N.C." not in markdown(table_of(made("ctm=off", "seed=7")))


@pytest.mark.parametrize(
    ("arguments", "metrics", "banner"),
    [
        (("trainer=smoke",), {}, True),
        ((), {"measured": False}, True),
        (("trainer=smoke",), {"measured": True}, False),
        ((), {}, False),
    ],
)
def test_a_test_of_the_command_says_so(made, arguments, metrics, banner):
    folder = made("ctm=off", *arguments, steps=20, **metrics)
    assert ("20 steps: a test of the command, not a measurement." in table_of(folder).notes) == banner
    made("ctm=auto", steps=1000)
    assert not any("a test of the command" in note for note in table_of(folder.parent).notes)
