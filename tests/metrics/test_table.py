"""One entry makes a metric: everything that people read of a run has it."""

import io
from dataclasses import replace

import pytest
import torch
from pages import load
from rich.console import Console
from tensorboard.backend.event_processing.event_multiplexer import EventMultiplexer

from ctm_plugin.color.light import Light
from ctm_plugin.loggers.services import TensorBoard, layout
from ctm_plugin.metrics.evaluate import summarize, summarize_alignment
from ctm_plugin.metrics.image import ssim
from ctm_plugin.metrics.lpips import LPIPS
from ctm_plugin.metrics.rendered import Alignment, Lit, View
from ctm_plugin.metrics.table import METRICS, PLACES, Metric, of_lit
from ctm_plugin.report.labels import Found
from ctm_plugin.report.runs import Run
from ctm_plugin.report.tables import all_runs
from ctm_plugin.report.text import FORMATS
from ctm_plugin.show.console import print_line, print_summary, print_sweep
from ctm_plugin.show.snapshot import compared
from ctm_plugin.workflows import demo

NEW = Metric(
    label="contrast", about="the spread of levels | of a view", higher=False, unit="levels", decimals=1, told=PLACES,
    view=lambda view: 255.0 * float(view.prediction.std()),
    alignment=lambda found: found.rendered.flatten(1).std(1),
    curve=("contrast/test_view", "contrast of a test view"),
)  # fmt: skip


@pytest.fixture
def result(monkeypatch) -> dict:
    """What ``metrics.json`` of a run holds, with one more metric."""
    monkeypatch.setitem(METRICS, "contrast", NEW)
    views = torch.rand(2, 12, 12, 3)
    run = {"dataset": "ball", "backbone": "dvgo", "ctm": "off", "seed": 0, "steps": 3, "protocol": ""}
    return summarize(("a", "b"), views, views.flip(0), None) | run | {"train_seconds": 1.0}


@pytest.fixture
def view() -> View:
    reference = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0)) / 2
    lit = Lit(reference, reference + 0.1, reference + 0.01, reference + 0.001)
    return View(torch.zeros(32, 32, 3), torch.zeros(32, 32, 3), lit=lit)


PICTURES = {"": ("rendered", 20), "_photo": ("photo", 40), "_fitted": ("fitted", 60)}


@pytest.mark.parametrize(("suffix", "which", "decibels"), [(suffix, *given) for suffix, given in PICTURES.items()])
def test_a_lit_picture_is_scored_against_the_reference(view, suffix, which, decibels):
    entries = of_lit(which, suffix, ("run",), "lit", "lit views")
    assert list(entries) == [f"{name}_lit{suffix}" for name in ("psnr", "ssim", "lpips")]
    scored, similar, distant = entries.values()
    assert scored.view(view) == pytest.approx(decibels, abs=0.01)
    assert 0.5 < similar.view(view) == float(ssim(getattr(view.lit, which), view.lit.reference)) <= 1
    assert distant.view(view) is None
    model = LPIPS("alex").requires_grad_(False)
    expected = float(model(getattr(view.lit, which), view.lit.reference))
    assert distant.view(replace(view, lpips=model)) == pytest.approx(expected, rel=1e-4)
    assert expected > 0
    if which == "photo":  # the one that may be missing
        without = replace(view, lit=replace(view.lit, photo=None))
        assert [entry.view(without) for entry in entries.values()] == [None] * 3


def test_summary(result):
    each = [row["contrast"] for row in result["per_image"]]
    assert result["contrast"] == pytest.approx(sum(each) / 2)
    assert 60 < each[0] < 90


def test_summary_of_an_alignment(monkeypatch):
    monkeypatch.setitem(METRICS, "contrast", NEW)
    patches, picture, warps = torch.rand(5, 6, 6, 3), torch.rand(12, 12, 3), torch.zeros(5, 8)
    found = summarize_alignment(Alignment(patches, patches.flip(0), picture, picture / 2, warps, warps + 1, 1.0))
    each = [row["contrast"] for row in found["per_patch"]]
    assert found["contrast"] == pytest.approx(sum(each) / 5)


def test_terminal(result, tmp_path, capsys):
    text = f"{result['contrast']:.1f} levels"
    print_summary(result, tmp_path)
    print_line(result, tmp_path)
    print_sweep([("seed=0", result)], tmp_path)
    told = capsys.readouterr().out
    assert f"contrast {text}  " in told  # of a sweep's run
    assert told.count(text) == 3
    out = io.StringIO()
    console = Console(file=out, width=200)
    console.print(demo.comparison(console, {"off": result, "auto": result}))
    assert "contrast" in out.getvalue()
    assert "+0.0" in out.getvalue()


def test_report(result, tmp_path):
    config = {"seed": 0, "trainer": {}}
    scores = result | {"converged": True, "protocol": "", "steps": 1}
    usual = {"backbone": "dvgo", "color_space": "rgb", "loss": "mse", "appearance": "none"}
    runs = [
        Run(tmp_path / ctm, config, scores | {"contrast": value}, usual | {"ctm": ctm}, {}, ctm)
        for ctm, value in (("off", 70.0), ("on", 60.0))
    ]
    table = all_runs(Found(runs, [], []))
    column = next(index for index, column in enumerate(table.columns) if column.metric == "contrast")
    assert [cells[column].rank for _, cells in table.rows] == [2, 1]
    assert "contrast, levels ↓" in FORMATS["md"]([table])
    assert "**60.0**" in FORMATS["md"]([table])


def test_dashboard(result, tmp_path):
    assert layout()["Quality"]["contrast of a test view"] == ["Multiline", ["contrast/test_view$"]]
    picture = torch.rand(4, 5, 3)
    shown = compared(picture, picture / 2, picture, None, Light())
    assert shown.scores["contrast"] == pytest.approx(255 * float(picture.std()))
    TensorBoard(TensorBoard.Config(), tmp_path, 0).log_scores({"ctm": "off"}, result)
    events = EventMultiplexer({"run": str(tmp_path / "tensorboard" / "final")}).Reload()
    assert events.Scalars("run", "final/contrast")[0].value == pytest.approx(result["contrast"])


def test_documentation(monkeypatch):
    monkeypatch.setitem(METRICS, "contrast", NEW)
    row = r"| `contrast` | contrast | levels | ↓ | views, patches | the spread of levels \| of a view |"
    assert row in load("docs/reference.py").scores().splitlines()


def test_values_as_text():
    texts = {"psnr": "31.23 dB", "ssim": "31.2346", "train_seconds": "31 s", "corner_error": "31.23 pixels"}
    assert {name: METRICS[name].text(31.23456) for name in texts} == texts
    assert METRICS["peak_memory_mb"].text(12345.6) == "12,346 MiB"
    assert METRICS["train_seconds"].text(12345.6) == "12346 s"


def test_every_entry_is_of_something_and_says_what():
    for name, metric in METRICS.items():
        assert metric.about, name
        assert set(metric.told) <= set(PLACES), name
        assert set(metric.of) <= {"views", "patches"}, name
        assert metric.curve is None or metric.view is not None, name
