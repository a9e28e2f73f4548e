"""The order in which pictures are painted, with a clock of our own."""

import threading
from itertools import pairwise

import pytest

from ctm_plugin.view.painter import AT_ONCE, COARSEST, GUESS, WORTH, Limit, Painter

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

    def paint(self, look, size, go_on):
        self.begun.append((look, size))
        self.during.pop((look, size), lambda: None)()
        return (size, size**2 / self.speed) if go_on() else None

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


def test_pictures_get_finer_until_the_finest():
    studio = Studio()
    studio.ask(0, "a")
    studio.work()
    first = sizes(studio)[0]
    assert first**2 / GUESS <= AT_ONCE < (2 * first) ** 2 / GUESS
    assert sizes(studio) == [first * 2**i for i in range(len(sizes(studio)))]
    assert sizes(studio)[-1] == FINEST
    assert not studio.painter.step()


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
    assert first == COARSEST or first**2 / speed <= AT_ONCE
    assert 2 * first > limit.finest or (2 * first) ** 2 / speed > AT_ONCE
    assert last <= limit.finest
    assert last == COARSEST or last**2 / speed <= limit.seconds
    assert last == limit.finest or (WORTH * last + 1) ** 2 / speed > limit.seconds


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


def test_what_the_same_renderings_do_for_is_as_fine_at_once():
    studio = Studio()
    studio.ask(0, "a, dark")
    studio.work()
    studio.shown.clear()
    studio.ask(0, "a, light")
    studio.work()
    assert studio.shown == [(0, "a, light", FINEST)]
    studio.ask(0, "b")
    studio.work()
    assert sizes(studio)[1] < FINEST


def test_asking_for_the_same_again_paints_nothing():
    studio = Studio()
    studio.ask(0, "a")
    studio.work()
    studio.ask(0, "a")
    assert not studio.painter.step()


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
    studio = Studio(GUESS)
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


def test_who_has_gone_is_painted_for_no_more():
    studio = Studio()
    studio.ask(0, "a")
    studio.ask(1, "b")
    studio.painter.step()
    studio.painter.step()
    studio.painter.forget(0)
    studio.work()
    assert len(sizes(studio, 0)) == 1
    assert sizes(studio, 1)[-1] == FINEST


def test_painting_again_stays_as_fine_as_it_is():
    studio = Studio()
    studio.ask(0, "a")
    studio.ask(1, "b")
    studio.work()
    studio.shown.clear()
    studio.painter.repaint(lambda look: look == "a")
    studio.work()
    assert studio.shown == [(0, "a", FINEST)]


def test_painting_again_begins_a_picture_in_progress_anew():
    studio = Studio()
    studio.during["a", 256] = lambda: studio.painter.repaint(lambda look: True)
    studio.ask(0, "a")
    studio.work()
    assert studio.begun.count(("a", 256)) == 2
    assert sizes(studio).count(256) == 1
    assert sizes(studio)[-1] == FINEST


def test_work_waits_and_ends():
    studio, shown = Studio(), threading.Event()
    studio.during["a", 32] = shown.set
    thread = threading.Thread(target=studio.painter.work)
    thread.start()
    studio.ask(0, "a")
    assert shown.wait(20)
    studio.painter.close()
    thread.join(20)
    assert not thread.is_alive()


def test_closing_stops_a_first_picture_too():
    studio = Studio()
    studio.during["a", 32] = studio.painter.close
    studio.ask(0, "a")
    studio.painter.work()
    assert studio.shown == []
