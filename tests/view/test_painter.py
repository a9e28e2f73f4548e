"""Pictures of looks out of sources that count how often they render, and the order in which they are painted."""

import threading
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from ctm_plugin.color.light import Light
from ctm_plugin.view.camera import BrowserCamera
from ctm_plugin.view.painter import (
    ASSUMED_SPEED,
    FIRST_SECONDS,
    MIN_GROWTH,
    MIN_SIDE,
    Limit,
    Look,
    Painter,
    Renderings,
    Viewpoint,
)

SHOT = Viewpoint(BrowserCamera((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0, 2.0))


class Flat:
    """One grey, times the gain."""

    def __init__(self, grey: float):
        self.grey, self.calls = grey, []

    def render(self, shot, height, width, check):
        self.calls.append((shot, height, width))
        check()
        return {"rgb": torch.full((height, width, 3), self.grey)}

    def picture(self, rendered, kind, light):
        return rendered["rgb"] * light.gain


@pytest.fixture
def pair():
    return Flat(0.2), Flat(0.4)


def wanted() -> None:
    """Whatever is painted."""


HALF = SHOT._replace(camera=replace(SHOT.camera, aspect=1.0))


@pytest.mark.parametrize(
    ("number", "layout", "split", "row", "calls"),
    [
        (1, "slider", 0.5, [0.2] * 8, [(SHOT, 4, 8)]),
        (2, "slider", 0.25, [0.2, 0.2, 1, 0.4, 0.4, 0.4, 0.4, 0.4], [(SHOT, 4, 8)]),
        (2, "slider", 0.0, [0.4] * 8, [(SHOT, 4, 8)]),
        (2, "slider", 1.0, [0.2] * 8, [(SHOT, 4, 8)]),
        (2, "side by side", 0.25, [0.2, 0.2, 0.2, 0.2, 1, 0.4, 0.4, 0.4], [(HALF, 4, 4)]),
    ],
)
def test_what_a_look_shows(pair, number, layout, split, row, calls):
    picture, seconds = Renderings().paint(Look(SHOT, pair[:number], layout, split), 8, wanted)
    assert picture.shape == (4, 8, 3)
    assert picture[0, :, 0].tolist() == pytest.approx(row)
    assert pair[0].calls == calls
    assert 0 < seconds < 10


def test_another_light_kind_or_split_needs_no_rendering(pair):
    renderings, first = Renderings(), Look(SHOT, pair)
    again = first._replace(split=0.1, kind="lit", light=Light(2.0))
    assert first.alike(again)
    assert renderings.paint(first, 8, wanted)[1] == renderings.paint(again, 8, wanted)[1]
    assert [len(source.calls) for source in pair] == [1, 1]
    for other in (
        first._replace(layout="side by side"),
        first._replace(shot=SHOT._replace(background=(1, 1, 1))),
        first._replace(sources=(Flat(0.2), pair[1])),
    ):
        assert not first.alike(other)
    renderings.clear()  # as another checkpoint has it done
    renderings.paint(first, 8, wanted)
    assert [len(source.calls) for source in pair] == [2, 2]


def test_what_was_stopped_is_rendered_anew(pair):
    calls, renderings = iter([wanted, lambda: 1 / 0, wanted]), Renderings()
    with pytest.raises(ZeroDivisionError):
        renderings.paint(Look(SHOT, pair), 8, lambda: next(calls)())
    renderings.paint(Look(SHOT, pair), 8, lambda: next(calls)())
    assert [len(source.calls) for source in pair] == [1, 2]


FINEST = Limit().finest


class Named(str):
    """A look; those are alike that begin with the same letter."""

    def alike(self, other):
        return self[0] == other[0]


class Studio:
    """A painter whose pictures take ``size ** 2 / speed`` seconds; ``during`` is called once as a picture begins."""

    def __init__(self, speed: float = 1e6):
        self.speed, self.during = speed, {}
        self.begun, self.shown = [], []
        self.painter = Painter(self.paint, self.show)

    def ask(self, client, look, *limit):
        self.painter.ask(client, Named(look), *limit)

    def paint(self, look, size, check):
        self.begun.append((look, size))
        self.during.pop((look, size), lambda: None)()
        check()
        return size, size**2 / self.speed

    def show(self, client, look, picture, seconds):
        self.shown.append((client, look, picture))
        assert seconds == picture**2 / self.speed

    def work(self):
        while self.painter.step():
            pass

    def ask_during(self, at, client, look):
        """A client asks for a look as the picture ``at`` begins."""
        self.during[at] = lambda: self.ask(client, look)


def sizes(studio: Studio, client: int = 0) -> list[int]:
    return [size for who, _, size in studio.shown if who == client]


@pytest.mark.parametrize("speed", [50.0, 2e3, 6e4, 1e9])
@pytest.mark.parametrize("limit", [Limit(), Limit(700, 1.0), Limit(16, 0.1)])
def test_how_coarse_and_how_fine_follow_from_speed_and_limit(speed, limit):
    studio = Studio(speed)
    studio.ask(0, "a", limit)
    studio.work()
    studio.shown.clear()
    studio.ask(0, "b", limit)
    studio.work()
    first, last = sizes(studio)[0], sizes(studio)[-1]
    assert first == MIN_SIDE or first**2 / speed <= FIRST_SECONDS
    assert 2 * first > limit.finest or (2 * first) ** 2 / speed > FIRST_SECONDS
    assert last <= limit.finest
    assert last == MIN_SIDE or last**2 / speed <= limit.seconds
    assert last == limit.finest or (MIN_GROWTH * last + 1) ** 2 / speed > limit.seconds


def test_other_limits_go_on_from_what_is_shown():
    studio = Studio()
    studio.ask(0, "a", Limit(256))
    studio.work()
    studio.shown.clear()
    studio.ask(0, "a", Limit(600))
    studio.work()
    assert sizes(studio) == [256, 512, 600]
    studio.ask(0, "a", Limit(100))
    studio.work()
    assert sizes(studio)[3:] == [100]


def test_moving_stops_a_finer_picture():
    studio = Studio()
    studio.ask_during(("a", 256), 0, "b")
    studio.ask(0, "a")
    studio.work()
    assert (0, "a", 128) in studio.shown
    assert not any(look == "a" and size >= 256 for _, look, size in studio.shown)
    assert studio.shown[-1] == (0, "b", FINEST)


def test_a_first_picture_is_shown_though_the_client_moved_on():
    """Else a client who keeps moving would see nothing."""
    studio = Studio(ASSUMED_SPEED)
    for before, after in pairwise("abcdef"):
        studio.ask_during((before, 32), 0, after)
    studio.ask(0, "a")
    for _ in range(5):
        studio.painter.step()
    assert [look for _, look, _ in studio.shown] == list("abcde")


def test_coarse_pictures_go_before_fine_ones_of_others():
    studio = Studio()
    studio.ask_during(("a", 512), 1, "b")
    studio.ask(0, "a")
    studio.work()
    stopped = studio.begun.index(("a", 512))
    assert studio.begun[stopped + 1][0] == "b"
    assert sizes(studio, 0)[-1] == sizes(studio, 1)[-1] == FINEST
    assert studio.begun.count(("a", 512)) == 2
    studio.ask(0, "c")
    studio.painter.forget(0)
    assert not studio.painter.step()


def test_what_is_painted_again_and_what_the_same_renderings_do_for_is_as_fine_at_once():
    studio = Studio()
    studio.ask(0, "a, dark")
    studio.work()
    studio.shown.clear()
    studio.ask(0, "a, dark")
    studio.work()
    assert studio.shown == []
    studio.ask(0, "a, light")
    studio.work()
    studio.painter.repaint()
    studio.work()
    assert studio.shown == 2 * [(0, "a, light", FINEST)]


def test_it_waits_for_a_task():
    studio = Studio()
    assert not studio.painter.step(0.01)
    asking = threading.Timer(0.05, lambda: studio.ask(0, "a"))
    asking.start()
    assert studio.painter.step(20.0)
    asking.join()


def test_closing_stops_a_first_picture_too():
    studio = Studio()
    studio.during["a", 32] = studio.painter.close
    studio.ask(0, "a")
    studio.work()
    assert studio.shown == []
    assert studio.painter.closed
