"""``ctm report``: every format, and every mistake as one message."""

import csv
import io
from html.parser import HTMLParser

import pytest
from strangers import put

from ctm_plugin import cli

BIKES = ("dataset=rawnerf", "dataset.root=x")


def main(arguments: list[str]) -> int:
    return cli.main(["report", *arguments])


def test_markdown(table4, capsys):
    assert main([str(table4), "table=4", "data=RawNeRF"]) == 0
    text = capsys.readouterr().out
    assert "| w/o CTM | 30.50 ± 0.71 (2) | 31.67 | -1.17 |" in text
    assert "| full | **33.50 ± 0.71 (2)** | 33.38 | +0.12 |" in text
    assert "| full - w/o CTM | +3.00 ± 0.00 (2) better |" in text
    assert "Protocol: still_life, 2 test views." in text


def test_csv_reads_back(table4, made, capsys):
    """All tables are one."""
    for ctm in ("off", "on"):
        made(*BIKES, f"ctm={ctm}", dataset="bikes")
    assert main([str(table4), "format=csv"]) == 0
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert {row["table"].split(":")[0] for row in rows} == {"All runs", "Table 1"}
    first = next(row for row in rows if row["row"] == "still_life: ctm=quick" and row["metric"] == "psnr")
    assert (float(first["mean"]), first["seeds"], first["pairs"], first["against"]) == (33.5, "2", "2", "ctm=off")
    assert float(first["paired_difference"]) == 3.0


def test_the_papers_values_are_of_its_data_or_asked_for(made, capsys):
    own, raw = made("ctm=off"), made(*BIKES, "ctm=off", dataset="bikes")
    for arguments, there in (
        ([own], False), ([own, "table=4"], False), ([own, "table=4", "data=RawNeRF"], True),
        ([own, "data=RawNeRF"], True), ([raw, "table=4"], True),
    ):  # fmt: skip
        assert main(list(map(str, arguments))) == 0
        assert ("| 31.67 |" in capsys.readouterr().out) == there


def test_html_is_one_file(table4, tmp_path):
    out = tmp_path / "report.html"
    assert main([str(table4), "format=html", f"out={out}"]) == 0
    text = out.read_text()
    assert "33.50 ± 0.71 (2) ●" in text
    assert text.count('class="slider"') == 4
    assert text.count("data:image/png;base64,") == 1 + (5 + 4 + 4 + 4)  # four settings, beside lit ones the photograph
    assert text.count("<canvas>") == 2
    assert "http" not in text.replace("http-equiv", "")


class Tags(HTMLParser):
    """What a browser sees: elements and their attributes."""

    def __init__(self):
        super().__init__()
        self.seen: list[tuple[str, list]] = []

    def handle_starttag(self, tag, attributes):
        self.seen.append((tag, attributes))


def test_html_links_the_pages_of_runs(made, tmp_path):
    """From where the report is, though the folder's name has signs of addresses."""
    paged, _ = (folder := made("ctm=off")).rename(folder.with_name("a #1 & b")), made("ctm=on")
    (paged / "index.html").write_text("a page")
    (tmp_path / "out").mkdir()
    assert main([str(paged.parent), "format=html", f"out={tmp_path / 'out/report.html'}"]) == 0
    tags = Tags()
    tags.feed((tmp_path / "out/report.html").read_text())
    ((_, address),) = [attribute for tag, attributes in tags.seen if tag == "a" for attribute in attributes]
    assert address == "../runs/a%20%231%20%26%20b/index.html"


def test_html_shows_strings_of_strangers_as_text(made, tmp_path):
    """In every place of a run that the report shows: names, settings, scores, errors, the folder's own name."""
    evil = """\"'></style></title><script>alert(1)</script><img src=x onerror=alert(1)>{{ 7 * 6 }}"""
    scores = {"dataset": evil, "protocol": evil, "data": evil, "lpips_net": evil}
    folders = [
        made(f"ctm={ctm}", f"seed={seed}", views=True, **scores) for ctm, seed in (("off", 0), ("on", 0), ("off", 1))
    ]
    for folder, own in zip(folders, ((), ("ctm.preset",), ("color_space.name", "loss.kind")), strict=True):
        for key in ("backbone.name", "backbone.encoding", *own):
            put(folder / "config.yaml", key, evil)
    bad = folders[0].parent / "<script>alert(1)<"
    bad.mkdir()
    (bad / "error.txt").write_text(evil)
    out = tmp_path / "report.html"
    assert main([str(folders[0].parent), "format=html", f"out={out}"]) == 0
    tags = Tags()
    tags.feed(out.read_text())
    sliders = [attributes for _, attributes in tags.seen if ("class", "slider") in attributes]
    assert [attributes[1] for attributes in sliders] == [("style", "width: 256px")] * 4
    assert [tag for tag, _ in tags.seen].count("script") == 1  # the page's own
    assert not any(name.startswith("on") for _, attributes in tags.seen for name, _ in attributes)
    assert all(value.startswith("data:image/png;base64,") for _, a in tags.seen for name, value in a if name == "src")
    assert "{{ 7 * 6 }}" in out.read_text()
    assert "&lt;img src=x" in out.read_text()


def titles(text: str) -> list[str]:
    return [line[4:].split(":")[0] for line in text.splitlines() if line.startswith("###")]


def test_without_a_table_those_that_show_most(table4, made, capsys):
    assert main([str(table4)]) == 0
    assert titles(capsys.readouterr().out) == ["All runs"]  # the still life is not the paper's
    for arguments in (["ctm=off"], ["ctm=on"], ["ctm.weights.img=0"], ["ctm.weights.img=0", "ctm=on"]):
        made(*BIKES, *arguments, dataset="bikes")
    assert main([str(table4)]) == 0
    assert titles(capsys.readouterr().out) == ["All runs", "Table 4"]
    made(*BIKES, "ctm=off", "color_space=lab", dataset="bikes")
    made(*BIKES, "ctm.k=1", dataset="bikes")
    assert main([str(table4)]) == 0
    assert titles(capsys.readouterr().out) == ["All runs", "Table 2", "Table 4", "Table 5"]


def test_all_runs_come_first_and_the_papers_beside_its_data(made, capsys):
    made(*BIKES, "ctm=off", dataset="bikes")
    made(*BIKES, "ctm=auto", dataset="bikes", psnr=31.0, psnr_enhanced=21.0)
    assert main([str(made(*BIKES, "ctm=on", dataset="bikes").parent)]) == 0
    told = capsys.readouterr().out
    assert titles(told) == ["All runs", "Table 1"]
    first, papers = told.split("### Table 1")
    assert "brightened PSNR" in first
    names = [line.split(" | ")[0] for line in first.partition("Differences")[0].splitlines()]
    assert names[-4:-1] == ["| ctm=off", "| ctm=auto", "| ctm=on"]
    assert "31.67" not in first
    assert "| DVGO | 30.00 | 31.67 | -1.67 |" in papers
    assert "In no row of this table: 1 of the runs." in papers


def test_unfinished_runs_are_named(made, capsys):
    made("ctm=off")
    folder = made("ctm=on")
    (folder / "metrics.json").unlink()
    assert main([str(folder.parent)]) == 0
    assert f"left out: {folder}: not finished" in capsys.readouterr().err
    assert main([str(folder)]) == 1
    assert "none of them finished" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["RUN", "table=99"], "table: found 99, expected one of 1, 2"),
        (["RUN", "table=3"], "table 3: found none of its rows"),
        (["RUN", "data=x"], "data: found 'x', expected, with table=1, one of Synthetic-NeRF, RawNeRF"),
        (["RUN", "data=Synthetic-NeRF", "table=4"], "expected, with table=4, one of RawNeRF"),
    ],
)
def test_mistakes(made, refused, arguments, message):
    folder = made()
    assert message in refused("report", *(folder if argument == "RUN" else argument for argument in arguments))


def test_an_output_that_is_no_file(table4, capsys):
    assert main([str(table4), "out=."]) == 1
    assert "out: found '.', expected the name of a file" in capsys.readouterr().err
