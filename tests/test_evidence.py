"""Pages and data agree: every table of a page comes out of ``docs/evidence``, every measured figure stands there."""

import re

import pytest
from pages import LINK, PAGES, load, name_of, prose

pytestmark = pytest.mark.slow

tables = load("docs/evidence/tables.py")
MEASURED = re.compile(
    r"(?<![\w.,/^-])[-+]?(?:\d+\.\d+(?![\w.])|\d[\d,]*(?:\s?%|(?:\s|-)(?:dB|s|ms|seconds?|minutes?|hours?|GiB|MiB|GB|MB|times)\b))"
)
"""Decimal numbers, and whole ones with a unit."""
NUMBER = re.compile(r"[-+]?\d[\d,]*(?:\.\d+)?")

DATA = {
    "scores": [
        {"scene": scene, "backbone": backbone, "variant": "", "seed": seed, "psnr": psnr, "psnr_sd": sd, "ssim": ""}
        for scene, backbone, seed, psnr, sd in (
            ("buu", "dvgo", "0", "43.35", ""),
            ("buu", "dvgo", "1", "43.45", ""),
            ("buu", "dvgo", "2", "43.55", ""),
            ("buu", "splat", "0-2", "44", "0.3"),
            ("sofa", "dvgo", "0-2", "40.05", "0.4"),
            ("sofa", "splat", "0", "41", ""),
        )
    ],
    "timings": [{"name": "step", "what": "a|b", "value": "1.26", "device": "CPU"}],
    "published": [{"method": "theirs", "scene": "buu", "psnr": "N.C."}],
}
GRID = {
    "data": "scores",
    "rows": {"Buu": {"scene": "buu"}},
    "columns": {"voxels": {"backbone": "dvgo", "show": "psnr"}, "splats": {"backbone": "splat", "show": "psnr"}},
    "best": "max",
}


def figures(text: str) -> list[str]:
    """The measured figures of a page's prose, as numbers without their units."""
    return [NUMBER.match(found[0])[0].lstrip("+") for found in MEASURED.finditer(prose(LINK.sub("", text)))]


def made(**changed: object) -> str:
    return tables.markdown("t", GRID | changed, DATA)


def last_line(**changed: object) -> str:
    return made(**changed).splitlines()[-1]


# The pages


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_tables_are_those_of_the_data(page):
    text = page.read_text(encoding="utf-8")
    assert tables.filled(text, tables.read_tables(), tables.read()) == text, "make tables"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_figures_of_prose_are_in_the_data(page):
    rows = {row["figure"].lstrip("+") for row in tables.read()["figures"] if row["page"] == name_of(page)}
    found = set(figures(page.read_text(encoding="utf-8")))
    assert not found - rows, f"add {sorted(found - rows)} to docs/evidence/figures.csv; settings go in `code`"
    assert not rows - found, f"in figures.csv, but not on the page: {sorted(rows - found)}"


def test_every_table_and_every_figure_has_its_page():
    shown = {found[2] for page in PAGES for found in tables.BETWEEN.finditer(page.read_text(encoding="utf-8"))}
    assert set(tables.read_tables()) <= shown
    assert {row["page"] for row in tables.read()["figures"]} <= {name_of(page) for page in PAGES}


def test_rows_are_whole():
    """Scores are numbers, what a run was is said, and no command is bound to one machine."""
    data = tables.read()
    for name, rows in data.items():
        for number, row in enumerate(rows, start=2):
            assert not re.search(r"(?<![\w$.])/(work|home|tmp|root)\b", " ".join(row.values())), f"{name}.csv:{number}"
            assert row.get("commit", "known"), f"{name}.csv:{number}: no commit"
    keys = [tuple(row[key] for key in (*tables.SETTINGS[:-1], "seed", "device", "commit")) for row in data["scores"]]
    assert sorted(key for key in set(keys) if keys.count(key) > 1) == [], "a run twice in scores.csv"


def test_what_a_measured_figure_is():
    text = (
        "# 3.5 is one, 4 is none\n\nGains 1.25 dB, or +0.5, in 12 s, 40% of 3 runs at `0.7` in 1,200 MiB "
        "([2.5](x-1.5.md)), version 1.2.3, Table 4, 400x300, a 5-minute run, $0.3$.\n\n```\n9.9 s\n```\n\n"
        "<!-- table: x -->\n\n| 8.8 |\n\n<!-- end -->\n"
    )
    assert figures(text) == ["3.5", "1.25", "0.5", "12", "40", "1,200", "5"]


# The generator


def test_means_and_deviations_of_seeds():
    assert made(best="none").splitlines() == [
        "|  | voxels | splats |",
        "|---|---|---|",
        "| Buu | 43.45 ± 0.10 | 44.00 ± 0.30 |",
    ]


def test_bold_is_what_leads_by_more_than_seeds_differ():
    assert "| **44.00 ± 0.30** |" in last_line()
    assert "| **43.45 ± 0.10** |" in last_line(best="min")
    assert "**" not in last_line(rows={"Sofa": {"scene": "sofa"}})  # one seed
    leading, cell = tables.leading, tables.Cell
    assert leading([cell(1.0, 0.1), cell(1.3, 0.2), cell(0.0, 0.1)], "max") == 1
    assert leading([cell(1.0, 0.3), cell(1.25, 0.2)], "max") is None
    assert leading([cell(1.0, 0.1), cell(2.0, 0.1), cell(text="N.C.")], "min") == 0
    assert leading([cell(1.0, 0.1)], "max") is None


def test_columns_are_compared_where_they_show_one_score_and_rows_on_demand():
    data = DATA | {"scores": [row | {"ssim": "90"} for row in DATA["scores"] if row["seed"] != "1"]}
    both = {"a": {"backbone": "splat", "show": "psnr"}, "b": {"backbone": "splat", "show": "ssim", "digits": "0"}}
    assert tables.markdown("t", GRID | {"columns": both}, data).endswith("| Buu | 44.00 ± 0.30 | 90 |")
    rows = {"voxels": {"backbone": "dvgo", "scene": "sofa"}, "splats": {"backbone": "splat", "scene": "buu"}}
    down = made(rows=rows, columns={"PSNR": {"show": "psnr"}}, compare="rows")
    assert down.endswith("| splats | **44.00 ± 0.30** |")


def test_several_scenes_are_their_mean():
    line = last_line(rows={"both": {"scene": ["buu", "sofa"]}}, best="none")
    assert line == f"| both | {(43.45 + 40.05) / 2:.2f} ± {(0.1**2 + 0.4**2) ** 0.5 / 2:.2f} | 42.50 |"


def test_a_column_of_another_file():
    columns = {"paper": {"data": "published", "method": "theirs", "show": "psnr"}}
    assert last_line(where={"backbone": "dvgo"}, columns=columns) == "| Buu | N.C. |"


def test_a_plain_list():
    table = {"data": "timings", "where": {"name": "step"}, "show": {"What": "what", "s": "value"}, "digits": "1"}
    assert tables.markdown("t", table, DATA) == "| What | s |\n|---|---|\n| a\\|b | 1.3 |"


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"rows": {"Bike": {"scene": "bike"}}}, "rows.Bike.scene: no row has 'bike'"),
        ({"where": {"colour": "auto"}}, "where.colour: found colour, expected one of scene, backbone"),
        ({"where": {"seed": "1"}}, "rows.Buu, columns.splats: no row has psnr with "),
        ({"columns": {"any": {"show": "psnr"}}}, "columns.any: rows of several settings fit, name one of backbone: "),
        ({"columns": {"voxels": {"backbone": "dvgo", "show": "ssim"}}}, "columns.voxels: no row has ssim with"),
        ({"columns": {"voxels": {"backbone": "dvgo"}}}, "columns.voxels.show: found nothing, expected one of"),
        ({"data": "scors"}, "data: found scors, expected one of scores"),
        ({"best": "most"}, "best: expected max"),
        ({"digit": "3"}, "digit: no key of a table"),
    ],
)
def test_what_the_data_cannot_fill(changed, message):
    with pytest.raises(tables.TableError) as caught:
        made(**changed)
    assert str(caught.value).startswith("table t: ")
    assert message in str(caught.value)


def test_rows_may_end_early_but_not_late(tmp_path):
    (tmp_path / "scores.csv").write_text("a,b\n1\n2,3\n")
    assert tables.read(tmp_path) == {"scores": [{"a": "1", "b": ""}, {"a": "2", "b": "3"}]}
    (tmp_path / "scores.csv").write_text("a,b\n1,2,3\n")
    with pytest.raises(tables.TableError, match=r"scores\.csv, row 2: found more cells than the 2"):
        tables.read(tmp_path)


def test_a_gap_may_be_said():
    assert last_line(where={"seed": "1"}, missing="not run") == "| Buu | 43.45 | not run |"


def test_a_page_is_filled_in_place():
    text = "Before.\n\n<!-- table: t -->\nold\n<!-- end -->\n\nAfter.\n"
    new = tables.filled(text, {"t": GRID}, DATA)
    assert new == f"Before.\n\n<!-- table: t -->\n\n{made()}\n\n<!-- end -->\n\nAfter.\n"
    assert tables.filled(new, {"t": GRID}, DATA) == new
    for wrong in (text.replace("t -->", "u -->"), text.replace("<!-- end -->\n", ""), "<!-- end -->\n" + text):
        with pytest.raises(tables.TableError):
            tables.filled(wrong, {"t": GRID}, DATA)
