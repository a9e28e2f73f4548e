"""Pictures of looks out of sources that count how often they render."""

import pytest
import torch

from ctm_plugin.view import look as module
from ctm_plugin.view.camera import Camera
from ctm_plugin.view.look import Look, Renderings, Shot

SHOT = Shot(Camera((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0, 2.0))


class Flat:
    """One grey, lifted by the factor."""

    def __init__(self, grey: float):
        self.grey, self.version, self.newest, self.calls = grey, 0, 0, []

    def refresh(self):
        self.version = self.newest

    def render(self, shot, height, width, go_on):
        self.calls.append((shot, height, width))
        return {"rgb": torch.full((height, width, 3), self.grey)} if go_on() else None

    def picture(self, rendered, kind, factor):
        return rendered["rgb"] * factor


@pytest.fixture
def clock():
    return map(float, range(1000)).__next__


def yes() -> bool:
    return True


def test_one_source_fills_the_picture(clock):
    picture, seconds = Renderings(clock).paint(Look(SHOT, (Flat(0.25),), factor=2.0), 8, yes)
    assert torch.equal(picture, torch.full((4, 8, 3), 0.5))
    assert seconds == 1


def test_under_the_slider_both_are_whole(clock):
    left, right = Flat(0.2), Flat(0.4)
    picture, seconds = Renderings(clock).paint(Look(SHOT, (left, right), "slider", 0.25), 8, yes)
    assert picture[0, :, 0].tolist() == pytest.approx([0.2, 0.2, 1, 0.4, 0.4, 0.4, 0.4, 0.4])
    assert left.calls == right.calls == [(SHOT, 4, 8)]
    assert seconds == 2


def test_side_by_side_each_has_half_the_window(clock):
    left, right = Flat(0.2), Flat(0.4)
    picture, _ = Renderings(clock).paint(Look(SHOT, (left, right), "side by side", 0.25), 8, yes)
    assert picture[0, :, 0].tolist() == pytest.approx([0.2, 0.2, 0.2, 0.2, 1, 0.4, 0.4, 0.4])
    ((shot, *size),) = left.calls
    assert size == [4, 4]
    assert (shot.camera.fov, shot.camera.aspect) == (SHOT.camera.fov, 1.0)


@pytest.mark.parametrize("split", [-1.0, 0.0, 1.0, 7.0])
def test_the_sliders_ends(split, clock):
    picture, _ = Renderings(clock).paint(Look(SHOT, (Flat(0.2), Flat(0.4)), "slider", split), 8, yes)
    assert picture.unique().tolist() == pytest.approx([0.2 if split > 0.5 else 0.4])


def test_another_light_kind_or_split_needs_no_rendering(clock):
    sources, renderings = (Flat(0.2), Flat(0.4)), Renderings(clock)
    first = Look(SHOT, sources)
    again = first._replace(split=0.1, kind="lit", factor=2.0)
    assert first.alike(again)
    assert renderings.paint(first, 8, yes)[1] == renderings.paint(again, 8, yes)[1]
    assert [len(source.calls) for source in sources] == [1, 1]
    for other in (
        first._replace(layout="side by side"),
        first._replace(shot=SHOT._replace(background=(1, 1, 1))),
        first._replace(sources=(Flat(0.2), sources[1])),
    ):
        assert not first.alike(other)
    sources[0].newest = 1  # as another checkpoint is
    renderings.paint(first, 8, yes)
    assert [len(source.calls) for source in sources] == [2, 1]


def test_no_more_is_kept_than_allowed(monkeypatch, clock):
    monkeypatch.setattr(module, "KEPT", 100)
    source, renderings = Flat(0.2), Renderings(clock)
    for longest in (8, 10, 12, 8):
        renderings.paint(Look(SHOT, (source,)), longest, yes)
    assert [width for *_, width in source.calls] == [8, 10, 12, 8]
    renderings.paint(Look(SHOT, (source,)), 12, yes)
    assert len(source.calls) == 4


def test_it_stops_when_told(clock):
    right = Flat(0.4)
    answers = iter([True, False])
    assert Renderings(clock).paint(Look(SHOT, (Flat(0.2), right)), 8, lambda: next(answers)) is None
    assert len(right.calls) == 1
