"""One bar on a terminal, a line now and then elsewhere."""

import io
from types import SimpleNamespace

import lightning as L
import pytest
from rich.console import Console
from toy import Clock, Toy, small_ctm, trainer

from ctm_plugin.callbacks import progress
from ctm_plugin.callbacks.progress import ProgressLine
from ctm_plugin.show.bars import error_console


@pytest.fixture(autouse=True)
def clock(monkeypatch) -> None:
    monkeypatch.setattr(progress, "time", Clock(1.0))


def fit(console: Console, *callbacks: L.Callback, refresh: float = 3.0, **settings) -> ProgressLine:
    line = ProgressLine()
    line.console, line.refresh = console, refresh
    trainer(10, line, *callbacks, **settings).fit(Toy(10, small_ctm()))
    return line


def test_plain_lines_without_a_terminal():
    out = io.StringIO()
    fit(Console(file=out, width=200))
    lines = out.getvalue().splitlines()
    # The clock ticks once a batch and is asked for no more: every third step, and the last one.
    assert [line.split("  ")[0] for line in lines] == [f"training {step}/10" for step in (3, 6, 9, 10)]
    assert "  8 rays/s  ETA 7 s" in lines[0]  # 3 steps of 8 rays in 3 seconds; 7 steps are left
    for part in ("loss ", "PSNR ", "rays/s", "ETA 0 s"):
        assert part in lines[-1]


def test_accumulated_batches_are_one_step():
    out = io.StringIO()
    fit(Console(file=out, width=200), refresh=100.0, accumulate_grad_batches=2)
    (line,) = out.getvalue().splitlines()
    assert line.startswith("training 10/10")
    assert "  8 rays/s" in line  # 20 batches of 8 rays in 20 seconds


def test_the_first_step_which_compiles_says_nothing_of_the_rest(monkeypatch):
    """Nor does a slow stretch alone: it is the mean of all steps since."""
    times = iter([0.0, 100.0, *(100.0 + step for step in (1, 2, 12, 13, 14, 15, 16, 17, 18))])
    monkeypatch.setattr(progress, "time", SimpleNamespace(perf_counter=lambda: next(times)))
    out = io.StringIO()
    line = ProgressLine()
    line.console, line.refresh = Console(file=out, width=200), 5.0
    trainer(10, line).fit(Toy(10))
    first, slow, *_ = out.getvalue().splitlines()
    assert "ETA" not in first
    assert slow.startswith("training 4/10")
    assert slow.endswith("ETA 24 s")  # 6 steps of 12 s / 3


def test_one_bar_on_a_terminal():
    out = io.StringIO()
    line = fit(Console(file=out, force_terminal=True, width=200), refresh=1.0)
    assert "10/10" in out.getvalue()
    assert "PSNR" in out.getvalue()
    assert line._shown is None


def test_the_bar_is_taken_away_after_an_error():
    class Fail(L.Callback):
        def on_train_batch_end(self, *args):
            raise RuntimeError("ours")

    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=200)
    with pytest.raises(RuntimeError, match="ours"):
        fit(console, Fail())
    assert "\x1b[?25h" in out.getvalue()  # the cursor is back
    fit(console)  # and another bar can be shown


def test_progress_goes_to_standard_error(capsys):
    fit(error_console())
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "training 10/10" in captured.err
