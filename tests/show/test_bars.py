"""One bar over several things."""

import io

import pytest
from rich.console import Console

from ctm_plugin.show import bars


def test_each_thing_has_its_part_of_the_whole(monkeypatch):
    console = Console(file=io.StringIO(), force_terminal=True)
    monkeypatch.setattr(bars, "error_console", lambda: console)
    with bars.whole({"first": 30.0, "second": 10.0}):
        (over,) = bars._WHOLE
        done = lambda: over.progress.tasks[over.task].completed  # noqa: E731
        assert list(bars.tracked([1, 2, 3], "first")) == [1, 2, 3]
        assert done() == pytest.approx(30.0)
        with bars.bar("second", 4) as shown:
            shown(1, "one")
            assert done() == pytest.approx(32.5)
        with bars.bar("another", 4) as shown:
            shown(4)
        assert done() == pytest.approx(32.5)
    assert not bars._WHOLE


def test_nothing_is_shown_where_there_is_no_terminal(capsys):
    assert list(bars.tracked(range(3), "things")) == [0, 1, 2]
    assert capsys.readouterr() == ("", "")
